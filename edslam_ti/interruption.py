"""Signals that ask a run to end: Ctrl-C, SIGTERM (a scheduler's), SIGHUP (the terminal is gone)."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
PATIENCE = 2  # signals while frames are processed that wait for the end of the step


class Stopped(KeyboardInterrupt):
    """A signal has ended what was done."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number  # of the signal


class Interruption:
    """What signals have asked for so far.

    At first a signal raises `Stopped` at once. While frames are processed (`deferred`), it is only
    remembered, so that the step in hand is finished; the third one raises. While results are saved
    (`saving`), a signal makes the rest urgent: it breaks off the part at work where that is slow
    (`breakable`).
    """

    def __init__(self) -> None:
        self.number: int | None = None  # of the first signal
        self.is_urgent = False  # slow parts of saving are left out
        self._count = 0
        self._waits = False  # signals are remembered
        self._is_saving = False
        self._is_breakable = False

    @property
    def requested(self) -> bool:
        """Whether a signal has come."""
        return self.number is not None

    @property
    def is_ctrl_c_once(self) -> bool:
        """Whether all that has come is one Ctrl-C."""
        return self.number == signal.SIGINT and self._count == 1

    def forgive(self) -> None:
        """Forget the signals so far: they have been obeyed."""
        self.number, self.is_urgent, self._count = None, False, 0

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Take in a signal (as a handler of `signal.signal`)."""
        self._count += 1
        self.number = number if self.number is None else self.number
        if self._is_saving or self._count > 1:
            self.is_urgent = True
        if not self._waits or self._is_breakable or (not self._is_saving and self._count > PATIENCE):
            raise Stopped(number)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Remember signals: frames are being processed."""
        self._waits = True
        try:
            yield
        finally:
            self._waits = False

    @contextmanager
    def saving(self) -> Iterator[None]:
        """Let signals make the rest urgent: results are being saved (inside `deferred`)."""
        self._is_saving = True
        try:
            yield
        finally:
            self._is_saving = False

    @contextmanager
    def breakable(self) -> Iterator[None]:
        """Let a signal break off what takes long and can be left out (inside `saving`)."""
        self._is_breakable = True
        try:
            yield
        finally:
            self._is_breakable = False


@contextmanager
def signals_handled() -> Iterator[Interruption]:
    """Handle signals while the block runs; those that the process ignores (nohup) stay ignored."""
    interruption = Interruption()
    previous = {}
    try:
        for number in SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                previous[number] = signal.signal(number, interruption.handle)
    except ValueError:  # not the main thread: signals are someone else's
        previous = {}
    try:
        yield interruption
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
