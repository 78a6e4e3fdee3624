"""Prior of the motion: velocity changes little from frame to frame.

White noise on acceleration (Barfoot, Tong, Sarkka: Batch continuous-time trajectory estimation as exactly
sparse Gaussian process regression, 2014). With poses T_k at times t_k, d_k = t_{k+1} - t_k and velocities
v_k = log(T_k^-1 T_{k+1}) / d_k, the change v_k - v_{k-1} has variance q (d_{k-1} + d_k) / 2.
"""

import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edslam_ti.geometry import adjoint, inverse, se3_exp, se3_log

REMEMBERED = 20  # q and the error ratio are averaged over this many observations


@dataclass(frozen=True)
class MeasuredPose:
    """A pose and how well it is known."""

    index: int  # of the frame in the trajectory
    timestamp: float  # seconds
    T_world_camera: np.ndarray  # [4, 4]
    information: np.ndarray | None  # [6, 6] about xi in T exp(xi); None: exact


class MotionPrior:
    """Learns how quickly velocities change, and smooths poses accordingly."""

    def __init__(self) -> None:
        self._accelerations: deque[np.ndarray] = deque(maxlen=REMEMBERED)  # [6] q, as observed
        self._errors: deque[float] = deque(maxlen=REMEMBERED)  # ratios of observed to predicted squared error

    @property
    def is_known(self) -> bool:
        """Whether anything has been learned."""
        return len(self._accelerations) > 0 and len(self._errors) > 0

    @property
    def error(self) -> float:
        """Ratio of observed to predicted squared error."""
        return float(np.mean(self._errors))

    def learn_motion(self, timestamps: np.ndarray, poses: Sequence[np.ndarray]) -> None:
        """Learn q from three or more known poses, whose mean velocities differ with variance q d / 3."""
        spans = timestamps[2:] - timestamps[:-2]
        squares = np.diff(_velocities(timestamps, poses), axis=0) ** 2 * (3 / spans)[:, None]
        for translation, rotation in zip(squares[:, :3].mean(1), squares[:, 3:].mean(1)):
            self._accelerations.append(np.repeat([translation, rotation], 3))

    def learn_error(self, twist: np.ndarray, information: np.ndarray) -> None:  # [6], [6, 6]
        """Learn the ratio of observed to predicted squared error from a measurement's error."""
        self._errors.append(float(twist @ information @ twist) / 6)

    def smoothed(self, measured: Sequence[MeasuredPose]) -> list[np.ndarray]:  # N times [4, 4]
        """Return the most likely poses: one Gauss-Newton step from those measured."""
        q = np.mean(self._accelerations, 0)
        n, poses = len(measured), [m.T_world_camera for m in measured]
        timestamps = np.array([m.timestamp for m in measured])
        d, v = np.diff(timestamps), _velocities(timestamps, poses)
        H, g = np.zeros((n, 6, n, 6)), np.zeros((n, 6))
        for k, m in enumerate(measured):
            if m.information is not None:
                H[k, :, k] += m.information
        for k in range(1, n - 1):
            weight = 2 / (q * (d[k - 1] + d[k]))
            back = [adjoint(inverse(poses[j + 1]) @ poses[j]) for j in (k - 1, k)]
            J = {
                k - 1: back[0] / d[k - 1],
                k: -np.eye(6) / d[k - 1] - back[1] / d[k],
                k + 1: np.eye(6) / d[k],
            }
            for a in J:
                g[a] += J[a].T @ (weight * (v[k] - v[k - 1]))
                for b in J:
                    H[a, :, b] += J[a].T @ (weight[:, None] * J[b])
        free = [k for k, m in enumerate(measured) if m.information is not None]
        system = H[free][:, :, free].reshape(6 * len(free), -1)
        for k, twist in zip(free, -np.linalg.solve(system, g[free].ravel()).reshape(-1, 6)):
            poses[k] = poses[k] @ se3_exp(twist)
        return poses


def _velocities(timestamps: np.ndarray, poses: Sequence[np.ndarray]) -> np.ndarray:  # [N - 1, 6]
    moved = [se3_log(inverse(a) @ b) for a, b in itertools.pairwise(poses)]
    return np.array(moved) / np.diff(timestamps)[:, None]
