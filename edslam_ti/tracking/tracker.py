"""The interface of trackers, their results, and a tracker that returns the true poses."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from edslam_ti.frame import Frame
from edslam_ti.tracking.consistency import Consistency
from edslam_ti.trajectory import Trajectory


@dataclass(frozen=True)
class Measurement:
    """Uncertainty of a frame's pose relative to the frame it was aligned to."""

    reference: int  # index of the frame that it was aligned to
    covariance: np.ndarray  # [6, 6] of xi in T_reference_camera exp(xi); metres, radians


@dataclass(frozen=True)
class TrackingResult:
    """A pose and its quality. A failure is a result, not an exception."""

    T_world_camera: np.ndarray  # [4, 4]
    converged: bool
    quality: float  # fraction of patch pixels in agreement, 0 to 1
    message: str = ""  # why it failed, or another event for the log
    # Better poses T_world_camera [4, 4] of earlier frames, by index.
    corrections: Mapping[int, np.ndarray] = field(default_factory=dict)
    measurement: Measurement | None = None  # None: the pose is given or predicted, not measured
    distrusted: tuple[int, ...] = ()  # frames, this one or earlier ones, whose depth is wrong


@dataclass(frozen=True)
class Attempt:
    """A result, and whether it is good enough to skip a second attempt from another start."""

    result: TrackingResult
    is_sure: bool
    overlap: float  # share of the reference in view
    misfit: float = 0.0  # median absolute difference of log brightness


class Tracker(Protocol):
    """Finds the pose of a frame; the first frame gets the expected pose."""

    def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the pose of `frame`, expected near `guess` [4, 4]; `trajectory` holds the earlier poses.

        It must not change the trajectory: the result contains corrections of earlier poses.
        """

    def consistency(self, trajectory: Trajectory) -> Consistency | None:
        """Return whether events and depth of a finished run agree; None: the tracker does not know."""


class TruePoses:
    """A tracker that returns the true poses, for mapping alone (`--poses truth`)."""

    def __init__(
        self,
        true_pose: Callable[[float], np.ndarray | None],
        likely_pose: Callable[[float], np.ndarray] | None = None,  # used where there is no true pose
    ) -> None:
        self._true_pose, self._likely_pose = true_pose, likely_pose

    def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the true pose; where it is unknown, the frame is lost."""
        pose = self._true_pose(frame.timestamp)
        if pose is not None:
            return TrackingResult(pose, True, 1.0)
        if self._likely_pose is not None:
            guess = self._likely_pose(frame.timestamp)
        return TrackingResult(guess, False, 0.0, "no true pose at this time")

    def consistency(self, trajectory: Trajectory) -> None:
        """Return None: there is nothing to compare."""


def best_attempt(
    attempt: Callable[[np.ndarray], Attempt],  # from a start [4, 4]
    predicted: np.ndarray,  # [4, 4] at constant velocity
    last: np.ndarray,  # [4, 4] right after a sudden stop
) -> Attempt:
    """Return the better attempt; the one from the last pose is skipped if the first is sure."""
    first = attempt(predicted)
    if first.is_sure:
        return first
    second = attempt(last)
    return second if second.result.quality > first.result.quality else first
