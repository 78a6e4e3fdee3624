"""Limits of mapping: seconds of computing, the number of Gaussians, and which of them have faded."""

import math
import time
from collections.abc import Callable

from edslam_ti.mapping.gaussians import GaussianMap


class Budget:
    """Seconds of computing that mapping may take, growing with the seconds of data added."""

    def __init__(
        self,
        seconds_per_second: float | None,  # of computing, of data; None: no limit
        clock: Callable[[], float] = time.perf_counter,  # seconds
    ) -> None:
        self.spent = 0.0  # seconds
        self._rate = seconds_per_second
        self._clock = clock
        self._first = self._last = float("nan")  # seconds of data
        self._started: float | None = None  # None: not counting

    def start(self, timestamp: float | None = None) -> None:
        """Begin to count, with data up to a time stamp."""
        self._started = self._clock()
        if timestamp is not None:
            self._first = timestamp if math.isnan(self._first) else self._first
            self._last = timestamp

    def stop(self) -> None:
        """Stop counting."""
        self.spent, self._started = self._now(), None

    def left(self, share: float = 1.0) -> float:
        """Return how many seconds are left of a share of all that the data so far allows; below 0: none."""
        if self._rate is None:
            return math.inf
        return share * self._rate * (self._last - self._first) - self._now()

    def _now(self) -> float:
        return self.spent + (0.0 if self._started is None else self._clock() - self._started)


def stride_for_budget(
    stride: int,  # pixels, in an empty map
    fullness: float,  # share of the largest number of Gaussians that there is
) -> int:
    """Return the spacing of new Gaussians: beyond half of the largest number, the fuller the coarser.

    A map that is full could not show new surfaces at all.
    """
    remaining = min(1.0, 2 * (1 - fullness))
    return math.ceil(stride / math.sqrt(max(remaining, 1e-3)))


def prune_faded(gaussians: GaussianMap, min_opacity: float) -> None:
    """Remove the Gaussians whose opacity is not above the least one."""
    keep = gaussians.raw["logit_opacities"].detach().sigmoid() > min_opacity
    if not bool(keep.all()):
        gaussians.keep(keep)
