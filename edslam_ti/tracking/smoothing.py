"""Corrects poses between two frames with depth, using both ends and the motion prior.

Between depth images, poses are measured by brightness alone. Its drift is visible at the frames with depth at
both ends. It is distributed linearly over the frames between, and the motion prior smooths the result.
"""

from collections.abc import Sequence

import numpy as np

from edslam_ti.geometry import inverse, se3_exp, se3_log
from edslam_ti.kernels.patch_warp import NormalEquations
from edslam_ti.tracking.keyframes import BrightnessFrame
from edslam_ti.tracking.motion_prior import MeasuredPose, MotionPrior
from edslam_ti.trajectory import PathDraft

SMOOTHED_FROM = 2  # frames included before the smoothed ones; two give the velocity, more change nothing


class PoseSmoother:
    """Learns how quickly velocities change and how accurate brightness is, and corrects poses accordingly."""

    def __init__(self) -> None:
        self._motion = MotionPrior()
        self._settled: list[MeasuredPose] = []  # the last two frames with depth, and those between them

    def settle(
        self,
        frames: Sequence[BrightnessFrame],  # F >= 3, the first and the last with depth
        by_brightness: Sequence[tuple[np.ndarray, NormalEquations]],  # F poses [4, 4] by brightness alone
        recent: Sequence[BrightnessFrame],  # last frames, these among them
        path: PathDraft,
    ) -> None:
        """Correct the poses between the first and the last of the frames."""
        poses, systems = zip(*by_brightness)
        known = [path.pose(f.index) for f in (frames[0], frames[-1])]
        start, end = (se3_log(inverse(poses[k]) @ T) for k, T in zip((0, -1), known))
        self._learn([(start, systems[0].H), (end, systems[-1].H)], recent, path)
        first, last = frames[0], frames[-1]
        measured = [MeasuredPose(first.index, first.timestamp, known[0], None)]
        for f, T, system in zip(frames[1:-1], poses[1:-1], systems[1:-1]):
            share = (f.timestamp - first.timestamp) / (last.timestamp - first.timestamp)
            corrected = T @ se3_exp((1 - share) * start + share * end)
            # Errors of neighbouring frames are correlated: together they count as one measurement.
            information = system.H / (self._motion.error * (len(frames) - 2))
            measured.append(MeasuredPose(f.index, f.timestamp, corrected, information))
        measured.append(MeasuredPose(last.index, last.timestamp, known[1], None))
        self._smooth(measured, recent, path)

    def _learn(
        self,
        errors: list[tuple[np.ndarray, np.ndarray]],  # twists [6] and their information [6, 6]
        recent: Sequence[BrightnessFrame],
        path: PathDraft,
    ) -> None:
        """Learn from the errors of brightness alone, and from the poses of frames with depth."""
        for twist, information in errors:
            if twist.any():  # the keyframe has no error relative to itself
                self._motion.learn_error(twist, information)
        with_depth = [f for f in recent if f.depth is not None]
        timestamps = np.array([f.timestamp for f in with_depth])
        self._motion.learn_motion(timestamps, [path.pose(f.index) for f in with_depth])

    def _smooth(
        self, measured: list[MeasuredPose], recent: Sequence[BrightnessFrame], path: PathDraft
    ) -> None:
        """Smooth the poses of this interval between frames with depth, and again those of the one before."""
        if self._motion.is_known:
            follows = len(self._settled) > 0 and np.array_equal(
                self._settled[-1].T_world_camera, measured[0].T_world_camera
            )
            poses = [*(self._settled[:-1] if follows else []), *measured]
            before = [f for f in recent if f.index < poses[0].index][-SMOOTHED_FROM:]
            exact = [MeasuredPose(f.index, f.timestamp, path.pose(f.index), None) for f in before]
            for m, T in zip(poses, self._motion.smoothed([*exact, *poses])[len(exact) :]):
                path.replace(m.index, T)
        else:
            for m in measured:
                path.replace(m.index, m.T_world_camera)
        self._settled = measured
