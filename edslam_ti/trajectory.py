"""A camera path: key poses over time, interpolated along geodesics (Eq. 9), read and written as TUM."""

import bisect
import operator
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from edslam_ti.errors import DataError
from edslam_ti.geometry import interpolate, rotation_angle_deg
from edslam_ti.output import atomic_file


class Trajectory:
    """Poses `T_world_camera` [F, 4, 4] at strictly increasing times [F] in seconds."""

    def __init__(self, timestamps: np.ndarray | None = None, poses: np.ndarray | None = None) -> None:
        self._timestamps: list[float] = [] if timestamps is None else [float(t) for t in timestamps]
        self._poses: list[np.ndarray] = [] if poses is None else [np.array(p, np.float64) for p in poses]
        if len(self._timestamps) != len(self._poses):
            raise DataError(
                f"trajectory: expected one pose per time stamp, got {len(self._timestamps)} time "
                f"stamps and {len(self._poses)} poses"
            )
        if np.any(np.diff(self._timestamps) <= 0):
            raise DataError("trajectory: expected strictly increasing time stamps; sort or deduplicate them")

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def timestamps(self) -> np.ndarray:  # [F]
        return np.array(self._timestamps)

    @property
    def poses(self) -> np.ndarray:  # [F, 4, 4]
        return np.array(self._poses).reshape(-1, 4, 4)

    def pose(self, index: int) -> np.ndarray:  # [4, 4]
        """Return key pose `index`; negative counts from the end."""
        return self._poses[index]

    def timestamp(self, index: int) -> float:  # seconds
        """Return the time of key pose `index`; negative counts from the end."""
        return self._timestamps[index]

    def replaced(self, poses: Sequence[np.ndarray]) -> list[int]:
        """Return which of the first key poses are other arrays than these, which `pose` returned before."""
        if not any(map(operator.is_not, poses, self._poses)):  # an hour's poses within a millisecond or two
            return []
        return [k for k, (old, new) in enumerate(zip(poses, self._poses)) if old is not new]

    def append(self, timestamp: float, T_world_camera: np.ndarray) -> None:
        """Add a pose later than all others."""
        if self._timestamps and timestamp <= self._timestamps[-1]:
            raise DataError(f"trajectory: {timestamp} s is not later than {self._timestamps[-1]} s")
        self._timestamps.append(float(timestamp))
        self._poses.append(np.array(T_world_camera, np.float64))

    def replace(self, index: int, T_world_camera: np.ndarray) -> None:
        """Overwrite one pose (loop closure, bundle adjustment)."""
        self._poses[index] = np.array(T_world_camera, np.float64)

    def covers(self, timestamp: float, tolerance: float = 1e-6) -> bool:
        """Return whether `at` would interpolate, not extrapolate."""
        return bool(self._poses) and (
            self._timestamps[0] - tolerance <= timestamp <= self._timestamps[-1] + tolerance
        )

    def at(self, timestamp: float) -> np.ndarray:  # [4, 4]
        """Return the pose at a time: Eq. 9 inside the path, constant velocity beyond its ends."""
        if not self._poses:
            raise DataError("trajectory: no pose yet")
        if len(self._poses) == 1:
            return self._poses[0].copy()
        k = bisect.bisect_right(self._timestamps, timestamp) - 1
        k = min(max(k, 0), len(self._poses) - 2)
        start, end = self._timestamps[k], self._timestamps[k + 1]
        if timestamp == start:
            return self._poses[k].copy()
        pose = interpolate(
            torch.from_numpy(self._poses[k]),
            torch.from_numpy(self._poses[k + 1]),
            (timestamp - start) / (end - start),
        )
        return pose.numpy()

    def resampled(self, timestamps: np.ndarray) -> "Trajectory":
        """Return the path at other times (strictly increasing): `at` for all of them at once."""
        if len(self._poses) < 2 or len(timestamps) == 0:
            return Trajectory(timestamps, np.array([self.at(t) for t in timestamps]))
        stamps, poses = self.timestamps, torch.from_numpy(self.poses)
        k = np.clip(np.searchsorted(stamps, timestamps, side="right") - 1, 0, len(stamps) - 2)
        fraction = torch.from_numpy((timestamps - stamps[k]) / (stamps[k + 1] - stamps[k]))
        return Trajectory(timestamps, interpolate(poses[k], poses[k + 1], fraction).numpy())

    def spread(self, distance: float, angle: float) -> list[np.ndarray]:  # [4, 4] each
        """Return poses more than `distance` metres or `angle` degrees apart along the path, and the last."""
        chosen = self._poses[:1]
        for T in self._poses[1:]:
            motion = np.linalg.inv(chosen[-1]) @ T
            if np.linalg.norm(motion[:3, 3]) > distance or rotation_angle_deg(motion) > angle:
                chosen.append(T)
        if chosen and chosen[-1] is not self._poses[-1]:
            chosen.append(self._poses[-1])
        return chosen

    def length(self) -> float:
        """Return the length of the path in metres."""
        positions = self.poses[:, :3, 3]
        return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


class PathDraft:
    """A trajectory with one more pose at its end, and corrections that are not on it yet."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        self.newest = np.eye(4)  # T_world_camera of the frame after the trajectory's last
        self.corrections: dict[int, np.ndarray] = {}  # [4, 4] T_world_camera by index

    def __len__(self) -> int:
        return len(self.trajectory) + 1

    def pose(self, index: int) -> np.ndarray:  # [4, 4]
        """Return a frame's pose as it is corrected; `index` counts from the first frame."""
        if index == len(self.trajectory):
            return self.newest
        return self.corrections[index] if index in self.corrections else self.trajectory.pose(index)

    def replace(self, index: int, T_world_camera: np.ndarray) -> None:
        """Correct a frame's pose."""
        if index == len(self.trajectory):
            self.newest = T_world_camera
        else:
            self.corrections[index] = T_world_camera


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write lines `t tx ty tz qx qy qz qw` (seconds, metres, camera-to-world)."""
    with atomic_file(path) as temporary, temporary.open("w") as file:
        file.write("# timestamp tx ty tz qx qy qz qw\n")
        for t, T in zip(trajectory.timestamps, trajectory.poses):
            q = Rotation.from_matrix(T[:3, :3]).as_quat()
            file.write(f"{t:.9f} " + " ".join(f"{v:.9f}" for v in [*T[:3, 3], *q]) + "\n")


def read_tum(path: Path) -> Trajectory:
    """Read a TUM trajectory; '#' lines are comments; rows at or before the time of the last are dropped."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} not found")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of an empty file, which is an error below
            rows = np.loadtxt(path, comments="#", ndmin=2)
    except ValueError as error:
        raise DataError(f"{path}: expected lines 't tx ty tz qx qy qz qw'; {error}") from error
    if rows.size == 0 or rows.shape[1] != 8:
        raise DataError(f"{path}: expected 8 numbers a line (t tx ty tz qx qy qz qw), got {rows.shape}")
    if not np.isfinite(rows).all():
        raise DataError(f"{path}: holds values that are not finite; remove those lines")
    norms = np.linalg.norm(rows[:, 4:], axis=1)
    if np.any(norms < 1e-6):
        raise DataError(f"{path}: a quaternion is zero; expected unit quaternions qx qy qz qw")
    keep = np.concatenate([[True], rows[1:, 0] > np.maximum.accumulate(rows[:-1, 0])])
    rows = rows[keep]
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    return Trajectory(rows[:, 0], poses)
