"""Keeps what a viewer costs below a share of the time."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

LONGEST = 0.25  # seconds that one block counts at most: the first one compiles


class Throttle:
    """Counts seconds of work, and says whether there is room for more."""

    def __init__(self, share: float, allowance: float) -> None:
        """`share` of the time since the start may be spent, and `allowance` seconds at once at the start."""
        self.spent = 0.0  # seconds
        self._share, self._allowance = share, allowance
        self._started = time.perf_counter()

    @property
    def is_due(self) -> bool:
        """Whether there is time for work."""
        elapsed = time.perf_counter() - self._started
        return self.spent <= self._allowance + self._share * elapsed

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Count what the block takes: all of its time, in whatever thread."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.spent += min(time.perf_counter() - started, LONGEST)

    @contextmanager
    def counted_in_background(self) -> Iterator[None]:
        """Count the processor's time that the block takes, not what it waits for."""
        started = time.thread_time()
        try:
            yield
        finally:
            self.spent += min(time.thread_time() - started, LONGEST)

    def restart(self) -> None:
        """Begin anew: somebody looks again."""
        self.spent, self._started = 0.0, time.perf_counter()
