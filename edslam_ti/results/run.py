"""What a run has produced."""

import time
from dataclasses import dataclass, field

import numpy as np

from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, SampledSequence
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.slam import Slam
from edslam_ti.trajectory import Trajectory


@dataclass
class Run:
    """What a run has produced so far; complete enough at any time to be saved."""

    config: Config
    sequence: EventDepthSequence
    samples: SampledSequence
    slam: Slam
    held_out: set[int]  # sample indices kept from mapping
    contrast: ContrastThreshold
    num_events: int = 0
    finish_seconds: float = 0.0
    is_refined: bool = False  # the map's final steps are done
    is_interrupted: bool = False
    started: float = field(default_factory=time.perf_counter)
    messages: list[str] = field(default_factory=list)

    def note(self, message: str) -> None:
        """Add a line to the log, with the seconds since the start."""
        self.messages.append(f"{time.perf_counter() - self.started:8.2f} s  {message}")

    def note_once(self, message: str) -> None:
        """Add a line to the log unless it is there."""
        if not any(line.endswith(message) for line in self.messages):
            self.note(message)

    def true_trajectory(self) -> Trajectory | None:
        """Return the truth at those tracked times that it covers; None where there is none.

        This interpolates the whole path: whoever saves a run asks once and passes the answer on.
        """
        truth = self.sequence.truth
        if truth is None:
            return None
        times = [t for t in self.slam.trajectory.timestamps if truth.covers(t)]
        return truth.resampled(np.array(times)) if times else None
