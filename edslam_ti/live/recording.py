"""A recording as a source: its data at their own pace, as a camera would hand them over."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, open_folder, open_sequence
from edslam_ti.datasets.base import MIN_HISTORY, SAME_TIME
from edslam_ti.datasets.camera_file import CameraFile
from edslam_ti.errors import ConfigError
from edslam_ti.live.items import CameraItem, DepthItem, EndItem, EventsItem, ImageItem, Item

PIECE = 0.005  # seconds of events that are handed over at a time


class RecordingSource:
    """Plays a sequence: pieces of events, and images when they were taken (`Source`)."""

    def __init__(
        self,
        sequence: EventDepthSequence,
        pace: float,  # 1: its own; 2: twice as fast; 0: as fast as its data are taken
        start: float = 0.0,  # seconds to skip
        duration: float | None = None,  # seconds; None: to its end
        clock: Callable[[], float] = time.monotonic,  # seconds
    ) -> None:
        self._sequence, self._pace, self._clock = sequence, pace, clock
        self.description = f"{sequence.scene}, played{f' at {pace:g} times its pace' if pace else ''}"
        self.is_live = pace > 0
        first, last = sequence.time_range
        self.first = min([first, *sequence.depth_timestamps[:1]]) + start
        self._last = np.nextafter(last, np.inf) if duration is None else self.first + duration
        if duration is None and len(sequence.depth_timestamps):
            self._last = max(self._last, np.nextafter(float(sequence.depth_timestamps[-1]), np.inf))
        self._closed = threading.Event()

    @property
    def seconds(self) -> float:
        """Length of what is played."""
        return float(self._last - self.first)

    @property
    def camera(self) -> CameraItem:
        """The camera of the sequence, which is undistorted already; stamps are its seconds."""
        sequence, camera = self._sequence, self._sequence.camera
        names = ("width", "height", "fx", "fy", "cx", "cy")
        values = {name: getattr(camera, name) for name in names} | {"pixel_centres": "integer"}
        if sequence.contrast_threshold is not None:
            values["contrast_threshold"] = sequence.contrast_threshold
        pose = sequence.true_pose(self._first_frame)
        return CameraItem(CameraFile.model_validate(values), "s", "m", pose, sequence.has_events)

    @property
    def _first_frame(self) -> float:
        """Time (s) of the first usable depth image with enough events before it, as of SampledSequence."""
        sequence, stamps = self._sequence, self._sequence.depth_timestamps
        begin = max(sequence.time_range[0], self.first) + (
            MIN_HISTORY - SAME_TIME if sequence.has_events else 0
        )
        later = range(int(np.searchsorted(stamps, begin)), len(stamps))
        return next((float(stamps[k]) for k in later if sequence.depth_or_none(k) is not None), self.first)

    def items(self) -> Iterator[Item]:
        """Yield the data in the order of time, each when its time has come."""
        began = self._clock()
        yield self.camera
        for time_, item in self._timed():
            if self._pace:
                due = began + (time_ - self.first) / self._pace
                if self._closed.wait(max(0.0, due - self._clock())):
                    return
            elif self._closed.is_set():
                return
            yield item
        yield EndItem()

    def close(self) -> None:
        self._closed.set()

    def _timed(self) -> Iterator[tuple[float, Item]]:
        """Yield items and when they are complete, seconds."""
        sequence = self._sequence
        stamps, pictures = sequence.depth_timestamps, sequence.image_timestamps
        edges = np.arange(self.first, self._last + PIECE, PIECE)
        depth, image = (int(np.searchsorted(s, self.first)) for s in (stamps, pictures))
        for start, end in zip(edges, np.minimum(edges[1:], self._last)):
            events = sequence.events(float(start), float(end)) if sequence.has_events else None
            if events is not None and len(events):
                yield float(end), EventsItem(events.x, events.y, events.t, events.polarity)
            while image < len(pictures) and pictures[image] < end:
                picture = sequence.image_or_none(image)
                if picture is not None:
                    yield float(end), ImageItem(float(pictures[image]), picture)
                image += 1
            while depth < len(stamps) and stamps[depth] < end:
                yield float(end), DepthItem(float(stamps[depth]), sequence.depth_or_none(depth))
                depth += 1


def open_named(name: str, config: Config) -> EventDepthSequence:
    """Open a recording by its folder, or a scene that `--scene` would find."""
    folder = Path(name)
    if folder.is_dir():
        return open_folder(folder, config)
    try:
        return open_sequence(config.updated({"scene": name}))
    except ConfigError as error:
        raise ConfigError(f"{name}: no folder of a recording, and no scene: {error}") from error
