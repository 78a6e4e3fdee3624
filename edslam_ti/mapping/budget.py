"""Limits of mapping: computing time, number of Gaussians, and removal of Gaussians that have faded."""

import math
import time
from collections.abc import Callable

from edslam_ti.mapping.gaussians import GaussianMap


class Budget:
    """Seconds of computing that mapping may take; the budget grows with the seconds of data added."""

    def __init__(
        self,
        seconds_per_second: float | None,  # computing time per second of data; None: no limit
        clock: Callable[[], float] = time.perf_counter,  # seconds
    ) -> None:
        self.spent = 0.0  # seconds
        self._rate = seconds_per_second
        self._clock = clock
        self._first = self._last = float("nan")  # seconds of data
        self._started: float | None = None  # None: not counting

    def start(self, timestamp: float | None = None) -> None:
        """Begin to count; `timestamp`: the data now reaches this far."""
        self._started = self._clock()
        if timestamp is not None:
            self._first = timestamp if math.isnan(self._first) else self._first
            self._last = timestamp

    def stop(self) -> None:
        """Stop counting."""
        self.spent, self._started = self._now(), None

    def left(self, share: float = 1.0) -> float:
        """Return how many seconds are left of this share of the budget so far; negative: overspent."""
        if self._rate is None:
            return math.inf
        return share * self._rate * (self._last - self._first) - self._now()

    def _now(self) -> float:
        return self.spent + (0.0 if self._started is None else self._clock() - self._started)


def stride_for_budget(
    stride: int,  # pixels, in an empty map
    fullness: float,  # number of Gaussians divided by the largest number allowed
) -> int:
    """Return the spacing of new Gaussians, which grows once the map is more than half full.

    A full map could not show new surfaces at all.
    """
    remaining = min(1.0, 2 * (1 - fullness))
    return math.ceil(stride / math.sqrt(max(remaining, 1e-3)))


def prune_faded(gaussians: GaussianMap, min_opacity: float) -> None:
    """Remove the Gaussians whose opacity is at most `min_opacity`."""
    keep = gaussians.raw["logit_opacities"].detach().sigmoid() > min_opacity
    if not bool(keep.all()):
        gaussians.keep(keep)
