"""A camera path: poses over time, interpolated along geodesics (Eq. 9), read and written as TUM files."""

import bisect
import logging
import operator
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from edslam_ti.errors import LONGEST_MESSAGE, DataError, plain
from edslam_ti.geometry import interpolate, rotation_angle_deg
from edslam_ti.output import atomic_file
from edslam_ti.tables import read_table

SHORTEST_QUATERNION, LONGEST_QUATERNION = 0.1, 10.0  # norms; with few decimals they are not exactly 1
FARTHEST = 1e7  # m from the origin: map coordinates (UTM) end there
SAME_PLACE = 0.05  # m, entries of rotation matrices: coarse stamps repeat while the camera moves

logger = logging.getLogger(__name__)


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
        """Return pose `index`; negative indices count from the end."""
        return self._poses[index]

    def snapshot(self) -> "Trajectory":
        """Return a copy that later changes do not reach; it shares the poses, which are never changed."""
        copy = Trajectory()
        copy._timestamps, copy._poses = list(self._timestamps), list(self._poses)
        return copy

    def index_of(self, timestamp: float) -> int:
        """Return the index of the last pose at or before a time; -1: there is none."""
        return bisect.bisect_right(self._timestamps, timestamp) - 1

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
        """Return poses more than `distance` metres or `angle` degrees apart on the path, and the last one."""
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
    """A trajectory with one more pose at its end, and corrections that are not applied yet."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        self.newest = np.eye(4)  # T_world_camera of the frame after the trajectory's last
        self.corrections: dict[int, np.ndarray] = {}  # [4, 4] T_world_camera by index

    def __len__(self) -> int:
        return len(self.trajectory) + 1

    def pose(self, index: int) -> np.ndarray:  # [4, 4]
        """Return a frame's corrected pose; `index` counts from the first frame."""
        if index == len(self.trajectory):
            return self.newest
        return self.corrections[index] if index in self.corrections else self.trajectory.pose(index)

    def replace(self, index: int, T_world_camera: np.ndarray) -> None:
        """Correct a frame's pose."""
        if index == len(self.trajectory):
            self.newest = T_world_camera
        else:
            self.corrections[index] = T_world_camera


def write_tum(trajectory: Trajectory, path: Path, time_offset: float = 0.0) -> None:
    """Write lines `t tx ty tz qx qy qz qw` (seconds, metres, camera-to-world).

    `time_offset` seconds are added to every stamp in decimal arithmetic, so that stamps since the epoch are
    exact to the nanosecond, which float64 seconds are not.
    """
    offset = Decimal(time_offset)
    with atomic_file(path) as temporary, temporary.open("w") as file:
        file.write("# timestamp tx ty tz qx qy qz qw\n")
        for t, T in zip(trajectory.timestamps, trajectory.poses):
            q = Rotation.from_matrix(T[:3, :3]).as_quat()
            stamp = Decimal(f"{t:.9f}") + offset
            file.write(f"{stamp:.9f} " + " ".join(f"{v:.9f}" for v in [*T[:3, 3], *q]) + "\n")


def read_tum(path: Path, notes: list[str] | None = None, header_lines: int = 0) -> Trajectory:
    """Read a TUM trajectory, lines `t tx ty tz qx qy qz qw`; '#' begins a comment.

    Of the first `header_lines` lines, those that hold words are skipped.
    A line for each repair by `in_order` is appended to `notes`; without such a list it goes to the log.
    Raises `FileNotFoundError` or `DataError`.
    """
    if not path.is_file():
        raise FileNotFoundError(plain(f"{path} not found", LONGEST_MESSAGE))
    table = read_table(path, 8, "t tx ty tz qx qy qz qw", header_lines)
    rows, lines = table.rows, table.lines
    norms = np.linalg.norm(rows[:, 4:], axis=1)
    odd = (norms < SHORTEST_QUATERNION) | (norms > LONGEST_QUATERNION)
    if odd.any():
        row = int(odd.argmax())
        raise DataError(
            f"{path}: line {lines[row]}: expected a unit quaternion qx qy qz qw, got one of norm "
            f"{norms[row]:.3g} ({int(odd.sum())} such lines)"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    trajectory, mended = in_order(rows[:, 0], poses, lines, path)
    for text in mended:
        if notes is None:
            logger.warning("%s", text)
        else:
            notes.append(text)
    return trajectory


def in_order(
    times: np.ndarray,  # [N] seconds
    poses: np.ndarray,  # [N, 4, 4]
    lines: np.ndarray,  # [N] of the file, for messages
    path: Path,
) -> tuple[Trajectory, list[str]]:
    """Return the path sorted by time without repeated stamps, and a note for each repair.

    Raises `DataError` for two paths in one file (many stamps have a second pose elsewhere, or sorting makes
    the path longer), and for positions that no camera reaches.
    """
    position = poses[:, :3, 3]
    far = np.abs(position).max(1) > FARTHEST
    if far.any():
        row = int(far.argmax())
        raise DataError(
            f"{path}: line {lines[row]}: expected a position in metres, got "
            f"{', '.join(f'{v:.6g}' for v in position[row])}"
        )
    notes: list[str] = []
    order = np.argsort(times, kind="stable")
    first = order[np.searchsorted(times[order], times, side="left")]  # of the rows with a row's stamp
    is_repeated = first != np.arange(len(times))
    if is_repeated.any():
        differs = is_repeated & (np.abs(poses - poses[first])[:, :3].max((1, 2)) > SAME_PLACE)
        if differs.sum() >= 3 and differs.sum() > 0.1 * (~is_repeated).sum():
            row = int(differs.argmax())
            raise DataError(
                f"{path}: line {lines[row]}: a second pose for {times[row]:.9g} s, "
                f"{np.linalg.norm(position[row] - position[first[row]]):.3g} m from that in line "
                f"{lines[first[row]]}, and {int(differs.sum()) - 1} more such lines; two recordings in one "
                "file? keep one"
            )
        notes.append(
            f"{path}: {int(is_repeated.sum())} of {len(times)} rows repeat a time stamp (the first in "
            f"line {lines[int(is_repeated.argmax())]}) and are left out"
        )
    kept = order[~is_repeated[order]]
    late = times < np.maximum.accumulate(times)
    if late.any():
        row = int(late.argmax())
        before, after = _length(position[np.sort(kept)]), _length(position[kept])
        if after > 1.5 * before + 0.1:
            raise DataError(
                f"{path}: line {lines[row]}: time goes back to {times[row]:.9g} s, and in the order of time "
                f"the path would be {after:.3g} m long instead of {before:.3g} m; two recordings in one "
                "file? keep one"
            )
        notes.append(
            f"{path}: {int(late.sum())} of {len(times)} rows are not in the order of time (the first in "
            f"line {lines[row]}); sorted"
        )
    return Trajectory(times[kept], poses[kept]), notes


def _length(position: np.ndarray) -> float:  # [N, 3] m
    return float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())
