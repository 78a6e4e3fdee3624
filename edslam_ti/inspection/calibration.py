"""A small offset of clocks and a small rotation between depth and events, estimated from the data itself.

At every compared frame the tracker has two poses: one that depth decides, and one by brightness alone. Their
differences say how far depth is delayed and turned (tracking/consistency.py). Depth is corrected by that, and
tracked again, until nothing is left to correct. What stays is judged by the disagreement of the two poses.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, WrappedSequence
from edslam_ti.depth_reprojection import DepthReprojection
from edslam_ti.errors import DataError
from edslam_ti.inspection.event_volume import liveliest_part
from edslam_ti.inspection.tracked import Tracked, track
from edslam_ti.lenses import Lens

ROUNDS = 6
DELAY_STEP, ROTATION_STEP = 0.0005, np.radians(0.02)  # s, rad; smaller corrections end the search
LARGEST_DELAY, LARGEST_ROTATION = (
    0.2,
    np.radians(8.0),
)  # s, rad; beyond, a calibration is needed, not a correction

Progress = Callable[[str], None]  # receives what is being done


class ShiftedDepth(WrappedSequence):
    """A sequence whose depth was taken `delay` seconds before its stamps say."""

    def __init__(self, sequence: EventDepthSequence, delay: float) -> None:
        super().__init__(sequence)
        self.depth_timestamps = sequence.depth_timestamps - delay


class TurnedDepth(WrappedSequence):
    """A sequence whose depth camera is turned against the event camera; the kernels must have been "
    "started."""

    def __init__(self, sequence: EventDepthSequence, rotation: np.ndarray) -> None:
        """`rotation` [3] is the rotation vector (rad) from the depth camera to the event camera."""
        super().__init__(sequence)
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
        self._draw = DepthReprojection(Lens(sequence.camera, "plumb_bob", (0.0,) * 5), sequence.camera, T)

    def depth(self, index: int) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
        return self._draw(self._sequence.depth(index))


@dataclass(frozen=True)
class DepthCalibration:
    """What was estimated between depth and events."""

    delay: float  # s, by which depth images show an earlier time than their stamps
    rotation: np.ndarray  # [3] rad, rotation vector from the depth camera to the event camera
    sigma: np.ndarray  # [4] s, rad, rad, rad
    tracked: Tracked  # with depth corrected
    before: float  # disagreement of poses by depth and by brightness, in expected differences
    after: float

    @property
    def text(self) -> str:
        """One line for the log."""
        x, y, z = np.degrees(self.rotation)
        turned = f"turned by {x:.2f}, {y:.2f}, {z:.2f} deg (+- {np.degrees(self.sigma[1:].max()):.2f})"
        if not np.isfinite(self.sigma[1:]).all():
            turned = "perhaps turned (too few frames to tell)"
        late = "late" if self.delay >= 0 else "early"
        return (
            f"depth is {1000 * abs(self.delay):.1f} ms (+- {1000 * self.sigma[0]:.1f}) {late} and {turned} "
            f"against the events: {self.before:.1f} times the expected difference, corrected {self.after:.1f}"
        )


def aligned(sequence: EventDepthSequence, delay: float, rotation: np.ndarray) -> EventDepthSequence:
    """Return a sequence whose depth is corrected by a delay (s) and a rotation vector [3] (rad)."""
    turned = TurnedDepth(sequence, rotation) if np.any(rotation) else sequence
    return ShiftedDepth(turned, delay) if delay else turned


def calibrate_depth(
    sequence: EventDepthSequence,
    config: Config,
    progress: Progress,
    part: tuple[float, float] | None = None,  # s; None: the liveliest
) -> DepthCalibration:
    """Return the delay and the rotation of depth against events; the kernels must have been started.

    Raises `DataError` where the recording does not tell, or where depth is too far off for a correction.
    """
    part = part or liveliest_part(sequence)
    delay, rotation, sigma = 0.0, np.zeros(3), np.full(4, np.inf)
    first = best = _required(track(sequence, *part, config), sequence)
    for n in range(ROUNDS):
        progress(f"aligning depth with events, round {n + 1}")
        found = best.misalignment
        assert found is not None, "see _required"
        sigma = found.sigma
        step, turn = found.delay_s, np.where(np.isfinite(sigma[1:]), found.rotation, 0.0)
        if abs(step) < DELAY_STEP and np.abs(turn).max() < ROTATION_STEP:
            break
        next_rotation = (Rotation.from_rotvec(turn) * Rotation.from_rotvec(rotation)).as_rotvec()
        next_delay = delay + step
        if abs(next_delay) > LARGEST_DELAY or np.linalg.norm(next_rotation) > LARGEST_ROTATION:
            raise DataError(_too_far(sequence, next_delay, next_rotation))
        again = track(aligned(sequence, next_delay, next_rotation), *part, config)
        if not _is_better(again, best):  # a short motion tells a delay and a rotation apart badly
            next_rotation = rotation
            again = track(aligned(sequence, next_delay, rotation), *part, config)
        if again is None or not _is_better(again, best):
            break
        delay, rotation, best = next_delay, next_rotation, again
    return DepthCalibration(delay, rotation, sigma, best, disagreement(first), disagreement(best))


def disagreement(tracked: Tracked) -> float:
    """Return by how many expected differences poses by depth and by brightness differ."""
    return float("inf") if tracked.consistency is None else float(np.sqrt(tracked.consistency.disagreement))


def _is_better(again: Tracked | None, best: Tracked) -> bool:
    return again is not None and again.misalignment is not None and disagreement(again) <= disagreement(best)


def _required(tracked: Tracked | None, sequence: EventDepthSequence) -> Tracked:
    if tracked is None or tracked.misalignment is None or not np.isfinite(tracked.misalignment.sigma[0]):
        raise DataError(
            f"{sequence.scene}: calibrate: expected a few seconds of events and depth with a moving "
            "camera, got too little to compare the two; leave --calibrate out, or record a livelier motion"
        )
    return tracked


def _too_far(sequence: EventDepthSequence, delay: float, rotation: np.ndarray) -> str:
    angle = np.degrees(np.linalg.norm(rotation))
    return (
        f"{sequence.scene}: calibrate: depth seems off by {1000 * delay:.0f} ms and {angle:.1f} degrees, "
        f"more than a correction of {1000 * LARGEST_DELAY:.0f} ms and {np.degrees(LARGEST_ROTATION):.0f} "
        "degrees can mend: calibrate the cameras (docs/my_camera.md)"
    )
