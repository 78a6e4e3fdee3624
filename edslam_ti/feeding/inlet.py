"""The way in of a session: arrays become samples; threads may add to it at the same time."""

import math
import threading
from typing import Any

import numpy as np

from edslam_ti.config import Config
from edslam_ti.errors import DataError
from edslam_ti.feeding.cutter import SAME_MOMENT, Cut, SampleCutter
from edslam_ti.feeding.intake import Intake
from edslam_ti.feeding.sequence import FedSequence

GATHERED = 1.0  # s of data from which the contrast threshold is estimated where none is stated
NEED_IMAGES = ("open3d_rgbd", "splatam")  # methods that track by grey images


class Inlet:
    """Takes arrays in, and gives samples out once their data are complete; a lock is held for either."""

    def __init__(
        self,
        intake: Intake,
        config: Config,
        has_events: bool,
        reorder: float,  # seconds
        patience: float,  # seconds
    ) -> None:
        if not (reorder >= 0 and patience >= 0):  # not so for NaN
            raise DataError(f"reorder, patience: expected seconds from 0 on, got {reorder}, {patience}")
        self.intake = intake
        self.has_begun = False  # the method is built: samples may be cut
        self._needs_images = config.method in NEED_IMAGES
        self._estimates_contrast = config.contrast_threshold is None
        self._cutter = SampleCutter(
            config.max_interval, has_events, self._needs_images, reorder, patience, intake.counts
        )
        self._lock = threading.Lock()

    # --- in ---

    def add_events(self, x: Any, y: Any, t: Any, p: Any) -> None:
        """Add events; raises DataError for arrays that do not fit together."""
        with self._lock:
            self._cutter.add_events(self.intake.events(x, y, t, p))

    def add_depth(self, t: float, depth: Any) -> None:  # [H, W]
        """Add a depth image; None: one was taken but is not usable."""
        with self._lock:
            metres = None if depth is None else self.intake.depth(depth)
            self._cutter.add_depth(self.intake.second(t), metres)

    def add_image(self, t: float, image: Any) -> None:  # [H, W] or [H, W, 3]
        """Add a grey image."""
        with self._lock:
            self._cutter.add_image(self.intake.second(t), self.intake.image(image))

    def flush(self, until: float | None) -> None:
        """State that all data before a stamp (None: the newest) have been added."""
        with self._lock:
            self._cutter.flush(self._cutter.newest if until is None else self.intake.second(until))

    def finish(self) -> None:
        """State that all data have been added."""
        with self._lock:
            self._cutter.finish()

    # --- out ---

    def next_times(self, is_all: bool = False) -> list[float]:
        """Return the times (s) of samples that can be cut now: to the next depth image, or `is_all`."""
        with self._lock:
            times = self._cutter.next_times(is_all)
            return [] if times and self._begins_later(times[0]) else times

    def cut(self, number: int = 1) -> Cut | None:
        """Return the next sample, or up to `number` as one; None: there is none yet."""
        with self._lock:
            return self._cutter.cut(number) if self._cutter.next_times(number > 1) else None

    def gather(self, sequence: FedSequence) -> tuple[float, float]:
        """Hand the data before the first sample to the sequence; return the time (s) they cover."""
        with self._lock:
            cutter = self._cutter
            first = cutter.next_times()[0]
            depth_times = [first, *(time for time, _ in cutter.depths)]
            sequence.gather(cutter.queue.between(-math.inf, math.inf), depth_times, cutter.images)
            self.has_begun = True
            return first, cutter.newest

    @property
    def newest(self) -> float:
        """Newest stamp of all data, seconds; -inf: there are none."""
        return self._cutter.newest

    @property
    def num_waiting(self) -> int:
        """Events that wait."""
        return self._cutter.queue.number

    @property
    def notes(self) -> list[str]:
        """What was left out or repaired, a line each."""
        gaps = self._cutter.gaps_not_divided
        notes = [*self.intake.notes, *self.intake.counts.notes]
        return notes + ([f"{gaps} gaps between depth images are longer than a minute"] if gaps else [])

    def _begins_later(self, first: float) -> bool:
        """Whether the first frame waits for the data that the contrast threshold is estimated from."""
        cutter = self._cutter
        if self.has_begun or cutter.clock == math.inf:
            return False
        if self._needs_images and (
            not cutter.depths or cutter.newest_image < cutter.depths[0][0] - SAME_MOMENT
        ):
            return True  # methods ask for two depth images with images
        return self._estimates_contrast and bool(cutter.images) and cutter.clock < first + GATHERED


def is_pose(values: Any) -> bool:
    """Return whether values are a 4x4 matrix of numbers."""
    array = np.asarray(values)
    return array.shape == (4, 4) and array.dtype.kind in "iuf" and bool(np.isfinite(array).all())
