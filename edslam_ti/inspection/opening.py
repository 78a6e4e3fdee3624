"""Opens what is to be inspected: a recording in any layout, or a file of events alone."""

from pathlib import Path

from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, open_folder
from edslam_ti.datasets.camera_file import read_camera
from edslam_ti.datasets.event_recording import EventRecording
from edslam_ti.datasets.generic import events_in
from edslam_ti.errors import DataError
from edslam_ti.event_files import open_events
from edslam_ti.inspection.findings import Finding

EVENT_REPLICA = "event_threshold_*/gray_events_data.npy"


def open_path(path: Path, config: Config) -> tuple[EventDepthSequence | None, Finding | None]:
    """Return a recording, or the finding that its files cannot be used as they are.

    Raises `FileNotFoundError` and `ConfigError` where there is no recording.
    """
    try:
        return (EventRecording(path) if path.is_file() else open_folder(path, config)), None
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
