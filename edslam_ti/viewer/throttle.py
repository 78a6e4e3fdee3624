"""Keeps what a viewer costs below a share of what the run itself costs, in time of the processor.

Time on the wall would not do: on a machine that others use, too, a run gets only a part of it.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager

LONGEST = 0.25  # seconds that one block counts at most: the first one compiles


class Throttle:
    """Counts seconds of work, and says whether there is room for more."""

    def __init__(self, share: float, allowance: float) -> None:
        """`share` of the process's time may be spent, and `allowance` seconds at once at the start."""
        self.spent = 0.0  # seconds
        self._share, self._allowance = share, allowance
        self._started = time.process_time()

    @property
    def is_due(self) -> bool:
        """Whether there is time for work."""
        return self.spent <= self._allowance + self._share * (time.process_time() - self._started)

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Count what the process does meanwhile, in all of its threads."""
        started = time.process_time()
        try:
            yield
        finally:
            self.spent += min(time.process_time() - started, LONGEST)

    @contextmanager
    def counted_in_background(self) -> Iterator[None]:
        """Count what this thread does, beside others."""
        started = time.thread_time()
        try:
            yield
        finally:
            self.spent += min(time.thread_time() - started, LONGEST)

    def restart(self) -> None:
        """Begin anew: somebody looks again."""
        self.spent, self._started = 0.0, time.process_time()
