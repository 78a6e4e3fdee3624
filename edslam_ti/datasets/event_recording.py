"""A file of events alone, with the grey frames and the IMU that AEDAT4 files and bags also hold.

It has no depth and no known lens, so it can be inspected and converted, not run.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import EventDepthSequence
from edslam_ti.datasets.clocks import clock_offset
from edslam_ti.datasets.imu import in_order
from edslam_ti.errors import DataError, plain
from edslam_ti.event_files import open_events
from edslam_ti.event_files.aedat4 import aedat4_images, aedat4_imu, aedat4_streams, is_aedat4
from edslam_ti.event_files.bags import bag_images, bag_imu, bag_topics, is_bag
from edslam_ti.events import Events

Frames = Callable[[], Iterator[tuple[float, np.ndarray]]]  # s and pixels of every frame, from the first on


class EventRecording(EventDepthSequence):
    """A file of events, its frames where they are the events' size, and its IMU."""

    dataset = "events"
    contrast_threshold = None
    truth = None
    has_lens = False

    def __init__(self, path: Path, intrinsics: tuple[float, float, float, float] | None = None) -> None:
        """`intrinsics` are fx, fy, cx, cy (px); without them `camera` has a lens of 90 degrees."""
        events = open_events(path)
        self.scene, self.description = path.stem, f"file of events, {plain(path)}"
        if events.size is None:
            raise DataError(
                f"{path}: does not state the size of its image; put it into a folder with camera.json"
            )
        width, height = events.size
        self.has_lens = intrinsics is not None
        self.camera = Camera(
            width, height, *(intrinsics or (width / 2, width / 2, (width - 1) / 2, (height - 1) / 2))
        )
        self.time_offset = clock_offset(events.time_range[0])
        self._events = events.shifted(self.time_offset) if self.time_offset else events
        self.depth_timestamps = np.empty(0)
        for text in events.notes:
            self.note(text)
        self._frames = _frames(path)
        self._reader: Iterator[tuple[float, np.ndarray]] = iter(())
        self._next, self._kept = 0, np.empty(0, int)  # index of the frame that the reader gives next
        self.image_timestamps = self._times_of_frames()
        rows = _imu(path)
        if rows:
            table = np.array([[t, *values] for t, values in rows])
            self.imu = in_order(table[:, 0] - self.time_offset, table[:, 1:4], table[:, 4:7])

    @property
    def time_range(self) -> tuple[float, float]:
        return self._events.time_range

    def events(self, start: float, end: float) -> Events:
        return self._events.between(start, end)

    def depth(self, index: int) -> np.ndarray:
        raise IndexError("a file of events has no depth")

    def image(self, index: int) -> np.ndarray:  # [H, W] float32 in [0, 1]
        wanted = int(self._kept[index])
        if wanted < self._next or self._next == 0:  # frames can only be read one after the other
            self._reader, self._next = self._frames(), 0
        for _, pixels in self._reader:
            self._next += 1
            if self._next == wanted + 1:
                return pixels.astype(np.float32) / 255
        raise DataError(f"{self.scene}: frame {wanted} is not there any more")

    def _times_of_frames(self) -> np.ndarray:  # [I] s
        """Read all frames once; leave out those of another size, of more than 8 bits, and repeated stamps."""
        times: list[float] = []
        kept, number = [], 0
        for stamp, pixels in self._frames():
            is_usable = pixels.shape == self.camera.shape and pixels.dtype == np.uint8
            if is_usable and (not times or stamp > times[-1]):
                times.append(stamp)
                kept.append(number)
            number += 1
        if len(kept) < number:
            self.note(
                f"{number - len(kept)} of {number} images are left out: expected 8 bits, "
                f"{self.camera.width}x{self.camera.height} pixels and stamps in order"
            )
        self._kept = np.array(kept, int)
        return np.array(times) - self.time_offset


def _frames(path: Path) -> Frames:
    if is_aedat4(path) and "frame" in aedat4_streams(path).values():
        return lambda: aedat4_images(path)
    if is_bag(path) and _has(path, "Image"):
        return lambda: bag_images(path)
    return lambda: iter(())


def _imu(path: Path) -> list[tuple[float, np.ndarray]]:
    if is_aedat4(path) and "imus" in aedat4_streams(path).values():
        return list(aedat4_imu(path))
    if is_bag(path) and _has(path, "Imu"):
        return list(bag_imu(path))
    return []


def _has(path: Path, kind: str) -> bool:
    return any(name.startswith("sensor_msgs") and name.endswith(kind) for name in bag_topics(path).values())
