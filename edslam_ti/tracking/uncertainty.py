"""Covariances of poses, from the normal equations and the size of the residuals.

A Gauss-Newton system H of residuals divided by their standard deviation has the covariance s^2 H^-1. The mean
square s^2 of those residuals corrects assumed standard deviations that are too large or too small. The
formula treats residuals of neighbouring pixels as independent; INFLATION makes up for their correlation.

A frame's pose is measured relative to a reference frame, whose own covariance is added (transformed by the
adjoint). So sigmas grow from keyframe to keyframe, as drift does. Loop closures do not reduce them.
"""

from collections.abc import Sequence

import numpy as np

from edslam_ti.geometry import adjoint, inverse, se3_log
from edslam_ti.kernels.patch_warp import NormalEquations
from edslam_ti.tracking.tracker import Measurement, TrackingResult
from edslam_ti.trajectory import Trajectory

# Ratio of squared errors to s^2 H^-1, measured in simulated rooms: median over the frames of recordings with
# exact and Kinect-like depth at 20 and 5 Hz (docs/experiments.md).
INFLATION = 16.0
SMALLEST_SCALE = 1e-4  # s^2; exact depth would leave no uncertainty at all
UNKNOWN_MOTION = 0.5  # a lost frame's sigma grows by this share of its predicted motion
UNKNOWN_STEP = (0.01, 0.01)  # metres, radians: and by at least this


def covariance(systems: Sequence[NormalEquations]) -> np.ndarray | None:  # [6, 6] of xi in T exp(xi)
    """Return the covariance of the pose that minimises all systems together; None: not determined.

    Each system has residuals of one kind, and is scaled by their mean square.
    """
    information = np.zeros((6, 6))
    for system in systems:
        count = max(system.num_surface, system.num_depth)
        if count > 0:
            information += system.H / max(2 * system.cost / count, SMALLEST_SCALE)
    if not np.isfinite(information).all():
        return None
    values, vectors = np.linalg.eigh(information)
    if values[0] <= 0:
        return None
    return np.asarray(INFLATION * (vectors / values) @ vectors.T)


def measured(reference: int, systems: Sequence[NormalEquations]) -> Measurement | None:
    """Return the uncertainty of a pose relative to a reference frame; None: not determined."""
    found = covariance(systems)
    return None if found is None else Measurement(reference, found)


def absolute_covariances(
    results: Sequence[TrackingResult], trajectory: Trajectory
) -> list[np.ndarray]:  # [6, 6] each, of xi in T_world_camera exp(xi)
    """Return the covariance of every pose relative to the first, which is exact."""
    found: list[np.ndarray] = []
    for index, result in enumerate(results):
        if index == 0:
            found.append(np.zeros((6, 6)))
            continue
        measured = result.measurement
        if measured is None or not 0 <= measured.reference < index:
            found.append(_unmeasured(found[-1], trajectory, index))
            continue
        found.append(_carried(found[measured.reference], trajectory, measured.reference, index))
        found[-1] = found[-1] + measured.covariance
    return found


def sigmas(covariances: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:  # [F] metres, [F] degrees
    """Return the standard deviations of position and rotation: roots of the traces."""
    traces = np.array([[np.trace(c[:3, :3]), np.trace(c[3:, 3:])] for c in covariances]).reshape(-1, 2)
    position, rotation = np.sqrt(np.maximum(traces, 0)).T
    return position, np.degrees(rotation)


def _carried(covariance: np.ndarray, trajectory: Trajectory, a: int, b: int) -> np.ndarray:
    """Return the covariance of frame b that follows from that of frame a, given their exact relative pose."""
    A = adjoint(inverse(trajectory.pose(b)) @ trajectory.pose(a))
    return np.asarray(A @ covariance @ A.T)


def _unmeasured(before: np.ndarray, trajectory: Trajectory, index: int) -> np.ndarray:
    """Return the covariance of a frame whose pose is only predicted."""
    motion = se3_log(inverse(trajectory.pose(index - 1)) @ trajectory.pose(index))
    step = [
        max(UNKNOWN_MOTION * float(np.linalg.norm(part)), least)
        for part, least in zip((motion[:3], motion[3:]), UNKNOWN_STEP)
    ]
    growth = np.diag(np.repeat(np.square(step) / 3, 3))
    return _carried(before, trajectory, index - 1, index) + growth
