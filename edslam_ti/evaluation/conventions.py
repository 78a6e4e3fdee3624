"""Reads true poses under other conventions, to find the one that an estimate agrees with."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.evaluation.trajectories import align, align_views
from edslam_ti.geometry import inverse

EXPLAINED = 1 / 3  # a reading explains the error if at most this share of the views' distance remains
BETTER = 0.9  # a reading must leave less than this share of what an earlier, more usual one leaves
ROUNDS = 4  # of alternately aligning the paths and fitting the axes

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # its cameras look along -z, with y up


@dataclass(frozen=True)
class Reading:
    """Another way to read true poses."""

    looks: str  # how messages describe such poses
    read: Callable[[np.ndarray], np.ndarray]  # [P, 4, 4] -> [P, 4, 4]
    is_inverted: bool = False


READINGS = (
    Reading("quaternions wxyz, read as xyzw", lambda poses: _as_wxyz(poses)),
    Reading("inverted poses (world-to-camera)", inverse, is_inverted=True),
    Reading("OpenGL's axes (y up, z backwards)", lambda poses: poses @ OPENGL),
    Reading(
        "inverted poses (world-to-camera) in OpenGL's axes",
        lambda poses: inverse(poses) @ OPENGL,
        is_inverted=True,
    ),
    Reading("rotations from the world to the camera", lambda poses: _transposed(poses)),
)


def better_reading(
    estimated: np.ndarray,  # [P, 4, 4]
    true: np.ndarray,  # [P, 4, 4]
    size: float,  # m, distance to what the cameras see
) -> Reading | None:
    """Return the reading of the true poses that the estimate agrees with; None: none is clearly better."""
    axes = _other_axes(estimated, true, size)
    angle = np.degrees(Rotation.from_matrix(axes[:3, :3]).magnitude())
    other = Reading(
        f"poses of another frame, turned by {angle:.0f} deg against the camera (the body's?)",
        lambda poses: poses @ axes,
    )
    best, least = None, EXPLAINED * apart(estimated, true, size)
    for reading in (*READINGS, other):
        distance = apart(estimated, reading.read(true), size)
        if distance < (least if best is None else BETTER * least):
            best, least = reading, distance
    return best


def apart(estimated: np.ndarray, true: np.ndarray, size: float) -> float:  # [P, 4, 4] each, m -> m
    """Return the rms distance, after alignment, between points that two paths see at distance `size`."""
    moved = align_views(estimated, true, size) @ estimated
    squared = ((moved[:, :3, 3] - true[:, :3, 3]) ** 2).sum(1)
    squared += 0.5 * size**2 * ((moved[:, :3, :3] - true[:, :3, :3]) ** 2).sum((1, 2))  # a turn's square
    return float(np.sqrt(squared.mean()))


def ate_cm(estimated: np.ndarray, true: np.ndarray, with_scale: bool = False) -> float:
    """Return the rmse of positions [P, 4, 4] after alignment."""
    R, t, scale = align(estimated, true, with_scale)
    distances = np.linalg.norm(scale * estimated[:, :3, 3] @ R.T + t - true[:, :3, 3], axis=1)
    return 100 * float(np.sqrt((distances**2).mean()))


def rpe_cm_and_deg(estimated: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Return the rmse of the motions between consecutive poses [P, 4, 4]."""
    E = inverse(inverse(true[:-1]) @ true[1:]) @ (inverse(estimated[:-1]) @ estimated[1:])
    centimetres = 100 * np.linalg.norm(E[:, :3, 3], axis=1)
    degrees = np.degrees(Rotation.from_matrix(E[:, :3, :3]).magnitude())
    return float(np.sqrt((centimetres**2).mean())), float(np.sqrt((degrees**2).mean()))


def _as_wxyz(poses: np.ndarray) -> np.ndarray:
    """Return poses whose quaternions were written w x y z and read x y z w."""
    read = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return _turned(poses, Rotation.from_quat(read[:, [1, 2, 3, 0]]).as_matrix())


def _transposed(poses: np.ndarray) -> np.ndarray:
    return _turned(poses, np.swapaxes(poses[:, :3, :3], 1, 2))


def _turned(poses: np.ndarray, R: np.ndarray) -> np.ndarray:  # [P, 4, 4], [P, 3, 3] -> [P, 4, 4]
    turned = poses.copy()
    turned[:, :3, :3] = R
    return turned


def _other_axes(estimated: np.ndarray, true: np.ndarray, size: float) -> np.ndarray:  # [4, 4]
    """Return the rotation between the truth's frame and the camera under which the views fit best.

    The paths are aligned and the rotation is fitted alternately, starting from every rotation that exchanges
    axes.
    """
    best, least = np.eye(4), np.inf
    for R in Rotation.create_group("O").as_matrix():
        axes = np.eye(4)
        axes[:3, :3] = R
        for _ in range(ROUNDS):
            T = align_views(estimated, true @ axes, size)
            fit = np.einsum("nji,njk->ik", true[:, :3, :3], T[:3, :3] @ estimated[:, :3, :3])
            U, _, Vt = np.linalg.svd(fit)
            axes[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        distance = apart(estimated, true @ axes, size)
        if distance < least:
            best, least = axes, distance
    return best
