"""What a run has produced."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence
from edslam_ti.datasets.base import Samples
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.event_images.sensor import SensorEstimate
from edslam_ti.slam import Slam
from edslam_ti.trajectory import Trajectory
from edslam_ti.truth import true_poses_at

MOST_CHARACTERS = 300  # of a reason, whatever a library writes

T = TypeVar("T")


@dataclass
class Run:
    """What a run has produced so far; complete enough at any time to be saved."""

    config: Config
    sequence: EventDepthSequence
    samples: Samples
    slam: Slam
    held_out: set[int]  # sample indices kept from mapping
    contrast: ContrastThreshold
    sensor: SensorEstimate | None = None  # None: there are no events, or they do not tell
    num_events: int = 0
    finish_seconds: float = 0.0
    is_refined: bool = False  # the map's final steps are done
    is_interrupted: bool = False
    started: float = field(default_factory=time.perf_counter)
    messages: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)  # parts of the evaluation that failed, and why
    live_metrics: dict[str, Any] = field(default_factory=dict)  # of data that came while it was processed

    def note(self, message: str) -> None:
        """Add a line to the log, with the seconds since the start."""
        self.messages.append(f"{time.perf_counter() - self.started:8.2f} s  {message}")

    def attempt(self, part: str, make: Callable[[], T], otherwise: T) -> T:
        """Return what a part of the results is; where its data is at fault, note it and leave it out."""
        try:
            return make()
        except (OSError, ValueError) as error:  # DataError is a ValueError
            self.leave_out(part, error)
            return otherwise

    def leave_out(self, part: str, error: Exception) -> None:
        """Note that a part of the results is missing, and why, once."""
        reason = " ".join(str(error).split()) or type(error).__name__
        line = f"left out: {part}: {reason[:MOST_CHARACTERS]}"
        if line not in self.left_out:
            self.left_out.append(line)
            self.note(line)

    def note_once(self, message: str) -> None:
        """Add a line to the log unless it is there."""
        if not any(line.endswith(message) for line in self.messages):
            self.note(message)

    def true_trajectory(self) -> Trajectory | None:
        """Return the truth at those tracked times at which it is known; None where there is none.

        This interpolates the whole path: whoever saves a run asks once and passes the answer on.
        """
        truth, times = self.sequence.truth, self.slam.trajectory.timestamps
        if truth is None:
            return None
        poses, is_known = true_poses_at(truth, times)
        return Trajectory(times[is_known], poses[is_known]) if is_known.any() else None
