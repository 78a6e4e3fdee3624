"""What a tracker is, what it returns, and the tracker that knows the true poses."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from edslam_ti.frame import Frame
from edslam_ti.tracking.consistency import Consistency
from edslam_ti.trajectory import Trajectory


@dataclass(frozen=True)
class Measurement:
    """How exactly a frame's pose was measured against another frame's."""

    reference: int  # index of the frame that it was aligned to
    covariance: np.ndarray  # [6, 6] of xi in T_reference_camera exp(xi); metres, radians


@dataclass(frozen=True)
class TrackingResult:
    """A pose and how far it can be trusted. A failure is a result, not an exception."""

    T_world_camera: np.ndarray  # [4, 4]
    converged: bool
    quality: float  # fraction of patch pixels in agreement, 0 to 1
    message: str = ""  # why it failed, or what else is worth the log
    # Better poses T_world_camera [4, 4] of earlier frames, by index.
    corrections: Mapping[int, np.ndarray] = field(default_factory=dict)
    measurement: Measurement | None = None  # None: the pose is given or predicted, not measured
    distrusted: tuple[int, ...] = ()  # frames, this one or earlier ones, whose depth is wrong


@dataclass(frozen=True)
class Attempt:
    """A result, and whether it needs no second one from another start."""

    result: TrackingResult
    is_sure: bool
    overlap: float  # share of the reference in view
    misfit: float = 0.0  # median absolute difference of log brightness


class Tracker(Protocol):
    """Finds the pose of a frame; the first frame gets the pose it is expected at."""

    def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the pose of `frame`, expected near `guess` [4, 4]; `trajectory` holds those before it.

        What the frame says of earlier poses comes back as corrections: the trajectory is not changed here.
        """

    def consistency(self, trajectory: Trajectory) -> Consistency | None:
        """Return whether the data of a finished run told one motion; None: the tracker does not know."""


class TruePoses:
    """A tracker that knows: `--poses truth`, for mapping alone."""

    def __init__(
        self,
        true_pose: Callable[[float], np.ndarray | None],
        likely_pose: Callable[[float], np.ndarray] | None = None,  # where there is no true one
    ) -> None:
        self._true_pose, self._likely_pose = true_pose, likely_pose

    def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the true pose; where it is not known, the frame is lost."""
        pose = self._true_pose(frame.timestamp)
        if pose is not None:
            return TrackingResult(pose, True, 1.0)
        if self._likely_pose is not None:
            guess = self._likely_pose(frame.timestamp)
        return TrackingResult(guess, False, 0.0, "no true pose at this time")

    def consistency(self, trajectory: Trajectory) -> None:
        """Return nothing: true poses agree with themselves."""


def best_attempt(
    attempt: Callable[[np.ndarray], Attempt],  # from a start [4, 4]
    predicted: np.ndarray,  # [4, 4] at constant velocity
    last: np.ndarray,  # [4, 4] as after a sudden stop
) -> Attempt:
    """Return the attempt of better quality; the one from the last pose is left out if the first is sure."""
    first = attempt(predicted)
    if first.is_sure:
        return first
    second = attempt(last)
    return second if second.result.quality > first.result.quality else first
