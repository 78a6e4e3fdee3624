"""True poses in files of 4x4 matrices."""

from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.geometry import orthonormalized
from edslam_ti.tables import read_table
from edslam_ti.trajectory import Trajectory, in_order

ROUNDING = 4e-15  # of R R^T; a matrix written with fewer than 15 digits differs by more
MATRIX = "the 4x4 matrix T_world_camera, row by row"


def read_poses(path: Path) -> tuple[np.ndarray, np.ndarray]:  # [F, 4, 4], [F] lines of the file
    """Return the matrices of a file with 16 numbers a line, rotations orthonormal to rounding.

    Matrices that are so already stay as they are, to the bit.
    """
    table = read_table(path, 16, MATRIX)
    poses = table.rows.reshape(-1, 4, 4)
    check_rigid(poses, path, table.lines)
    return np.array([T if _is_exact(T[:3, :3]) else orthonormalized(T) for T in poses]), table.lines


def _is_exact(R: np.ndarray) -> bool:  # [3, 3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < ROUNDING)


def read_timed_poses(times_file: Path, poses_file: Path) -> tuple[Trajectory, list[str]]:
    """Return the path of a file with a time (s) a line and one with a matrix a line, and notes.

    Rows that are out of order are sorted, repeated stamps left out; the notes say so.
    """
    times = read_table(times_file, 1, "time [s]")
    poses, _ = read_poses(poses_file)
    if len(times.rows) != len(poses):
        raise DataError(
            f"{times_file.parent}: expected one pose per time, got {len(times.rows)} times in "
            f"{times_file.name} and {len(poses)} poses in {poses_file.name}"
        )
    return in_order(times.rows[:, 0], poses, times.lines, times_file)


def check_rigid(poses: np.ndarray, path: Path, lines: np.ndarray) -> None:  # [F, 4, 4], [F]
    """Refuse matrices that are not rigid motions to within 1e-3."""
    R = poses[:, :3, :3]
    deviation = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    bottom = np.abs(poses[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(1)
    bad = (deviation > 1e-3) | (bottom > 1e-3) | (np.linalg.det(R) < 0)
    if bad.any():
        row = int(bad.argmax())
        raise DataError(
            f"{path}: line {lines[row]}: expected a rigid motion (rotation, translation in metres, last row "
            f"0 0 0 1), got {np.array2string(poses[row].ravel(), precision=4, max_line_width=10**6)}"
        )
