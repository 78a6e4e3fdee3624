"""The interface of viewers, and what they are shown."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import Sample
from edslam_ti.mapping.mapper import Mapper
from edslam_ti.slam import Slam
from edslam_ti.trajectory import Trajectory

Say = Callable[[str], None]  # receives a line for the terminal


@dataclass(frozen=True)
class Moment:
    """The state of a run after a frame, or while the map is refined.

    Everything belongs to the run and changes with it: a viewer copies what it keeps, before it returns.
    """

    slam: Slam
    camera: Camera
    sample: Sample | None  # the newest frame's data; None while the map is refined
    num_frames: int = 0  # of the whole run; 0: not known
    truth: Trajectory | None = None
    error_cm: float | None = None  # ATE so far, where the truth is known

    @property
    def trajectory(self) -> Trajectory:
        """The poses so far."""
        return self.slam.trajectory

    @property
    def mapper(self) -> Mapper | None:
        """The map; None: the run only tracks."""
        return self.slam.mapper

    @property
    def hertz(self) -> float:
        """Frames per second of tracking and mapping, on average."""
        seconds = self.slam.tracking_seconds + self.slam.mapping_seconds
        return len(self.slam.results) / seconds if seconds > 0 else 0.0

    def log_brightness(self) -> np.ndarray | None:  # [h, w]
        """Return the newest image that the tracker knows from events; None where it makes none."""
        image = getattr(self.slam.tracker, "log_brightness", None)
        return None if image is None else image()


class Viewer(Protocol):
    """Shows a run in progress."""

    def update(self, moment: Moment) -> None:
        """Show the state of the run, and return at once."""

    def wait(self, is_ended: Callable[[], bool]) -> None:
        """Return when the run may go on: at once, unless somebody has paused it; or when `is_ended`."""

    def close(self) -> None:
        """Stop showing, because the run has been saved."""


class NoViewer:
    """Shows nothing."""

    def update(self, moment: Moment) -> None:
        """Do nothing."""

    def wait(self, is_ended: Callable[[], bool]) -> None:
        """Return at once."""

    def close(self) -> None:
        """Do nothing."""
