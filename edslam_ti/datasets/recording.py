"""What the recordings of event cameras with a lens have in common: undistorted events on a clock from 0."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from edslam_ti.datasets.base import EventDepthSequence
from edslam_ti.datasets.clocks import check_clock, clock_offset, note_coverage
from edslam_ti.datasets.depth import look_at_images
from edslam_ti.datasets.imu import ImuData
from edslam_ti.errors import DataError, plain
from edslam_ti.event_files import EventStream
from edslam_ti.events import Events
from edslam_ti.lenses import Undistortion
from edslam_ti.trajectory import Trajectory

OTHER_DEPTH = "--depth-dir FOLDER reads depth from another folder (docs/data.md)"


class Recording(EventDepthSequence):
    """Events behind a lens, undistorted while they are read; subclasses add depth, images and truth.

    A subclass calls the constructor, then `set_depth`, `set_images`, `set_truth` and `set_imu` with stamps on
    the files' own clock, and `finish`.
    """

    contrast_threshold: float | None = None

    def __init__(self, folder: Path, events: EventStream, undistortion: Undistortion, name: str) -> None:
        self.scene = folder.name
        self._folder = folder
        self.description = f"{name}, {plain(folder)}, undistorted"
        self.camera = undistortion.camera
        self._undistortion = undistortion
        self.num_dropped_events = events.num_dropped
        for text in events.notes:
            self.note(text)
        self.time_offset = clock_offset(events.time_range[0])
        self._events = events.shifted(self.time_offset) if self.time_offset else events
        self._range = self._events.time_range
        self.depth_timestamps = self.image_timestamps = np.empty(0)
        self.truth = None
        self._read_depth: Callable[[int], np.ndarray] | None = None
        self._read_image: Callable[[int], np.ndarray] | None = None

    @property
    def time_range(self) -> tuple[float, float]:
        return self._range

    def events(self, start: float, end: float) -> Events:
        first, last = self._range
        if last < self._events.time_range[1]:  # cropped
            end = min(end, np.nextafter(last, np.inf))
        return self._undistortion.events(self._events.between(max(start, first), end))

    def depth(self, index: int) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
        assert self._read_depth is not None, "this recording has no depth"
        return self._read_depth(index)

    def image(self, index: int) -> np.ndarray:  # [H, W] float32 in [0, 1]
        assert self._read_image is not None, "this recording has no images"
        return self._read_image(index)

    def set_depth(self, times: np.ndarray, read: Callable[[int], np.ndarray], name: str) -> None:
        """Set the stamps (s, files' clock) of depth images and how to read one in the undistorted camera."""
        stamps = self._on_clock(times, name)
        kept = np.arange(len(stamps))
        if self._range != self._events.time_range:  # cropped
            kept = np.flatnonzero((stamps >= self._range[0]) & (stamps <= self._range[1]))
        self.depth_timestamps, self._read_depth = stamps[kept], lambda index: read(int(kept[index]))

    def set_images(self, times: np.ndarray, read: Callable[[int], np.ndarray], name: str) -> None:
        """Set the same of grey images."""
        self.image_timestamps, self._read_image = self._on_clock(times, name), read

    def set_truth(self, truth: Trajectory, name: str, T_body_camera: np.ndarray | None = None) -> None:
        """Set the true poses of a body that carries the camera; None: they are the camera's."""
        poses = truth.poses if T_body_camera is None else truth.poses @ T_body_camera
        self.truth = Trajectory(self._on_clock(truth.timestamps, name), poses)

    def set_imu(self, imu: ImuData, name: str) -> None:
        """Set the inertial measurements, stamps on the files' clock."""
        self.imu = imu.shifted(self.time_offset)
        check_clock(self, self._folder, name, self.imu.timestamps)

    def crop(self, start: float, end: float) -> None:
        """Leave out what lies outside of two times (s, files' clock); call it before `set_depth`."""
        first, last = self._range
        self._range = max(first, start - self.time_offset), min(last, end - self.time_offset)

    def finish(self, needs_depth: bool, what_is_missing: str) -> None:
        """Check what was set; `what_is_missing` says why there is no depth, and what can be done."""
        if needs_depth and len(self.depth_timestamps) == 0:
            raise DataError(f"{self._folder}: {what_is_missing}; {OTHER_DEPTH}")
        if len(self.depth_timestamps):
            note_coverage(self)
        look_at_images(self, self._folder)

    def _on_clock(self, times: np.ndarray, name: str) -> np.ndarray:  # [N] s
        shifted = np.asarray(times, np.float64) - self.time_offset
        check_clock(self, self._folder, name, shifted)
        return shifted
