"""Opens what is to be inspected: a recording in any layout, or a file of events alone."""

from pathlib import Path

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, open_folder
from edslam_ti.datasets.camera_file import read_camera
from edslam_ti.datasets.clocks import clock_offset
from edslam_ti.datasets.generic import events_in
from edslam_ti.errors import DataError, plain
from edslam_ti.event_files import EventStream, open_events
from edslam_ti.events import Events
from edslam_ti.inspection.findings import Finding

EVENT_REPLICA = "event_threshold_*/gray_events_data.npy"


class EventsAlone(EventDepthSequence):
    """A file of events without anything else; its camera has the file's size and no known lens."""

    dataset = "events"
    contrast_threshold = None
    truth = None

    def __init__(self, path: Path) -> None:
        events = open_events(path)
        self.scene, self.description = path.name, f"file of events, {plain(path)}"
        if events.size is None:
            raise DataError(
                f"{path}: does not state the size of its image; put it into a folder with camera.json"
            )
        width, height = events.size
        # Half the width is the focal length of a lens of 90 degrees; nothing here depends on it.
        self.camera = Camera(width, height, width / 2, width / 2, (width - 1) / 2, (height - 1) / 2)
        self.time_offset = clock_offset(events.time_range[0])
        self._events: EventStream = events.shifted(self.time_offset) if self.time_offset else events
        self.depth_timestamps = self.image_timestamps = np.empty(0)
        for text in events.notes:
            self.note(text)

    @property
    def time_range(self) -> tuple[float, float]:
        return self._events.time_range

    def events(self, start: float, end: float) -> Events:
        return self._events.between(start, end)

    def depth(self, index: int) -> np.ndarray:
        raise IndexError("a file of events has no depth")

    def image(self, index: int) -> np.ndarray:
        raise IndexError("a file of events has no images")


def open_path(path: Path, config: Config) -> tuple[EventDepthSequence | None, Finding | None]:
    """Return a recording, or the finding that its files cannot be used as they are.

    Raises `FileNotFoundError` and `ConfigError` where there is no recording.
    """
    try:
        return (EventsAlone(path) if path.is_file() else open_folder(path, config)), None
    except DataError as error:
        if path.is_dir() and _fits_transposed(path):
            return None, Finding(
                "swapped_axes",
                "x and y look swapped in the events (or width and height in camera.json): they fit the "
                f"other way round; swap the columns. As it is: {error}",
            )
        return None, Finding("refused", str(error))


def _fits_transposed(folder: Path) -> bool:
    """Return whether a recording's events fit an image of its height and width, but not the other way "
    "round."""
    try:
        size = read_camera(folder / "camera.json").camera.shape  # (height, width): as if it were transposed
        own = [path for path in (events_in(folder), *sorted(folder.glob(EVENT_REPLICA))) if path is not None]
        if len(own) != 1 or size[0] == size[1]:
            return False
        open_events(own[0], size)
    except (DataError, OSError):
        return False
    try:
        open_events(own[0], (size[1], size[0]))
    except DataError:
        return True
    return False
