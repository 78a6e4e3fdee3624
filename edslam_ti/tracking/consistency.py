"""Checks whether events and depth agree on the motion, which reveals faults of calibration and clocks.

At frames with depth the pose is measured twice: by brightness and depth together, where depth outweighs
brightness, and by brightness alone. Let T be the first pose, T_b the second, and X the motion since the
keyframe k according to T. The disagreement is d = log(T^-1 T_b). If depth images show the scene a delay tau
earlier than their stamps say, at the keyframe and now, then

    d = tau (v - Ad(X^-1) v_k) + noise,    v: velocities (translation, rotation) at the frame and the keyframe

which robust least squares solves for tau over all frames. The size of d, in units of its expected size, shows
whether the two kinds of data contradict each other (a wrong focal length, events of another recording, noisy
pixels). A wrong scale of depth cannot be detected: it scales both poses.
"""

from dataclasses import dataclass

import numpy as np

from edslam_ti.geometry import adjoint, inverse, se3_log
from edslam_ti.kernels.patch_warp import NormalEquations
from edslam_ti.trajectory import Trajectory

MOST = 60  # frames that are compared, distributed over the run
MIN_FRAMES = 6  # with fewer there is no result
MIN_FOR_ROTATION = 12  # with fewer there is no result for a rotation of depth
# Ratio of observed to expected squared disagreement, median over the frames. Simulated rooms: 9 to 46 without
# a fault; 480 with depth 50 ms late, 910 with a focal length 10 % too long, 2800 with 20 pixels that fire at
# 5 kHz.
CONTRADICTION = 100.0
# A delay is reported if it exceeds this many standard deviations and this many seconds. Simulated rooms give
# up to 3.5 standard deviations and 3 ms without a delay, 5.2 and 8 ms with depth 10 ms late.
SURE, SMALLEST_DELAY = 4.5, 0.004
# Smallest mean square of residuals that means something. The tiny simulated room gives 0.3, a sixtieth of its
# events 0.09, one or two hundred events in all 0.01: where events are few, brightness seems even.
SMALLEST_SCALE = 0.1
HUBER = 1.5  # standard deviations
WORST_CONDITION = 1e12  # of the equations for delay and rotation: beyond, the motion does not tell them
FROZEN_SHARE = 0.2  # depth has stopped if this share of the compared frames repeats the previous depth image


@dataclass(frozen=True)
class Consistency:
    """Agreement of events and depth over a whole run."""

    num_frames: int  # compared
    disagreement: float  # ratio of observed to expected squared disagreement
    depth_delay_s: float  # by which depth images show an earlier time than their stamps
    depth_delay_sigma_s: float
    repeated_share: float  # of the compared frames that repeat the previous depth image

    @property
    def problems(self) -> list[str]:
        """One line for each likely fault, with the remedy."""
        lines = []
        is_contradiction = self.disagreement > CONTRADICTION
        if is_contradiction and self.repeated_share > FROZEN_SHARE:
            return [
                f"{self.repeated_share:.0%} of the depth images repeat the one before although events show "
                "motion: the depth stream has stopped; its poses cannot be right"
            ]
        delay, sigma = self.depth_delay_s, self.depth_delay_sigma_s
        if abs(delay) > max(SURE * sigma, SMALLEST_DELAY):
            lines.append(
                f"depth looks {1000 * abs(delay):.0f} ms (+- {1000 * sigma:.0f}) too "
                f"{'late' if delay > 0 else 'early'} for the events; check the clocks of both streams"
            )
        if is_contradiction:
            lines.append(
                f"events and depth contradict each other ({np.sqrt(self.disagreement):.0f} times the "
                f"expected difference of poses, 3 to 7 is usual); check focal length, principal point, "
                "registration of depth to the event camera, noisy pixels, and whether events are missing"
            )
        return lines


@dataclass(frozen=True)
class Misalignment:
    """A delay and a rotation between depth and events that explain how their poses differ."""

    delay_s: float  # by which depth images show an earlier time than their stamps
    rotation: np.ndarray  # [3] rad, rotation vector of the depth camera in the event camera's frame
    sigma: np.ndarray  # [4] s, rad, rad, rad


@dataclass(frozen=True)
class _Comparison:
    """One frame, measured twice."""

    index: int
    keyframe: int
    disagreement: np.ndarray  # [6] d
    information: np.ndarray  # [6, 6] of T_b
    is_repeated: bool


class ConsistencyCheck:
    """Collects comparisons along a run."""

    def __init__(self) -> None:
        self._comparisons: list[_Comparison] = []
        self._every, self._count = 1, 0

    def wants(self) -> bool:
        """Return whether to compare the next frame with depth; the interval doubles when there are many."""
        self._count += 1
        return self._count % self._every == 0

    def add(
        self,
        index: int,  # of the frame
        keyframe: int,  # index of the frame it was aligned to
        T_world_camera: np.ndarray,  # [4, 4] by brightness and depth
        by_brightness: np.ndarray,  # [4, 4] T_world_camera
        system: NormalEquations,  # of the latter
        is_repeated: bool = False,  # its depth image repeats the previous one
    ) -> None:
        """Add a frame whose pose was measured twice."""
        scale = 2 * system.cost / max(system.num_surface, 1)
        if scale < SMALLEST_SCALE:  # hardly any pixel has texture to measure a pose by
            return
        difference = se3_log(inverse(T_world_camera) @ by_brightness)
        self._comparisons.append(_Comparison(index, keyframe, difference, system.H / scale, is_repeated))
        if len(self._comparisons) > MOST:
            self._comparisons = self._comparisons[1::2]
            self._every *= 2

    def result(self, trajectory: Trajectory) -> Consistency | None:
        """Return the result for the run; None: too few frames were compared."""
        if len(self._comparisons) < MIN_FRAMES:
            return None
        observed, expected, squares = [], [], []
        for c in self._comparisons:
            X = inverse(trajectory.pose(c.keyframe)) @ trajectory.pose(c.index)
            change = _velocity(trajectory, c.index) - adjoint(inverse(X)) @ _velocity(trajectory, c.keyframe)
            root = np.linalg.cholesky(c.information + 1e-9 * np.eye(6)).T
            observed.append(root @ c.disagreement)
            expected.append(root @ change)
            squares.append(float(c.disagreement @ c.information @ c.disagreement) / 6)
        delay, sigma = _robust_slope(np.concatenate(expected), np.concatenate(observed))
        repeated = float(np.mean([c.is_repeated for c in self._comparisons]))
        return Consistency(len(squares), float(np.median(squares)), delay, sigma, repeated)

    def misalignment(self, trajectory: Trajectory) -> Misalignment | None:
        """Return delay and rotation of depth; None: too few frames were compared.

        The rotation is 0, its standard deviation infinite, where they are too few for it.

        If depth is turned by the small rotation w (E = exp(w)), depth alone measures the motion E^-1 X E, so
        that d = (Ad(X^-1) - 1) w besides the delay's part.
        """
        if len(self._comparisons) < MIN_FRAMES:
            return None
        design, observed = [], []
        for c in self._comparisons:
            X = inverse(trajectory.pose(c.keyframe)) @ trajectory.pose(c.index)
            back = adjoint(inverse(X))
            change = _velocity(trajectory, c.index) - back @ _velocity(trajectory, c.keyframe)
            root = np.linalg.cholesky(c.information + 1e-9 * np.eye(6)).T
            design.append(root @ np.column_stack([change, (back - np.eye(6))[:, 3:]]))
            observed.append(root @ c.disagreement)
        A, y = np.concatenate(design), np.concatenate(observed)
        if len(self._comparisons) < MIN_FOR_ROTATION:
            delay, sigma_delay = _robust_slope(A[:, 0], y)
            return Misalignment(delay, np.zeros(3), np.array([sigma_delay, np.inf, np.inf, np.inf]))
        solution, sigma = _robust_solution(A, y)
        return Misalignment(float(solution[0]), solution[1:], sigma)


def _velocity(trajectory: Trajectory, index: int) -> np.ndarray:  # [6]
    """Return the velocity of the body around a frame, metres and radians per second."""
    a, b = max(index - 1, 0), min(index + 1, len(trajectory) - 1)
    stamps = trajectory.timestamps
    return np.asarray(se3_log(inverse(trajectory.pose(a)) @ trajectory.pose(b)) / (stamps[b] - stamps[a]))


def _robust_solution(A: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # [N, K], [N]
    """Return x [K] in y = A x, and its standard deviations, by iteratively reweighted least squares "
    "(Huber)."""
    weight, x, sigma = np.ones(len(y)), np.zeros(A.shape[1]), np.full(A.shape[1], np.inf)
    for _ in range(10):
        information = (A * weight[:, None]).T @ A
        if np.linalg.cond(information) > WORST_CONDITION:
            return np.zeros(A.shape[1]), np.full(A.shape[1], np.inf)
        x = np.linalg.solve(information, A.T @ (weight * y))
        residual = y - A @ x
        scale = 1.48 * float(np.median(np.abs(residual))) + 1e-9
        weight = 1 / np.maximum(1, np.abs(residual) / (HUBER * scale))
        sigma = scale * np.sqrt(np.diag(np.linalg.inv(information)))
    return x, sigma


def _robust_slope(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:  # [N], [N]
    """Return a in y = a x, and its standard deviation, by iteratively reweighted least squares (Huber)."""
    weight, slope, scale = np.ones(len(x)), 0.0, 1.0
    for _ in range(10):
        information = float((weight * x * x).sum())
        if information <= 0:
            return 0.0, float("inf")
        slope = float((weight * x * y).sum()) / information
        residual = y - slope * x
        scale = 1.48 * float(np.median(np.abs(residual))) + 1e-9
        weight = 1 / np.maximum(1, np.abs(residual) / (HUBER * scale))
    return slope, scale / float(np.sqrt((weight * x * x).sum()))
