"""The journal of a run: every pose as soon as it is known, so that no end of the process loses the path.

Lines of journal.csv: `frame,timestamp,tx,ty,tz,qx,qy,qz,qw,converged,message`, the time stamp on the
recording's own clock. A pose that is corrected later gets another line: the last line of a frame counts.
"""

import csv
import io
import os
import time
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.errors import DataError, plain
from edslam_ti.trajectory import Trajectory

JOURNAL = "journal.csv"
HEADER = "frame,timestamp,tx,ty,tz,qx,qy,qz,qw,converged,message"
SYNC_EVERY = 1.0  # seconds between the moments at which the disk has everything
LONGEST_MESSAGE = 200  # characters


class Journal:
    """Appends what is new on a trajectory to journal.csv; each line is handed to the system at once."""

    def __init__(
        self,
        path: Path,
        time_offset: float,  # seconds to add to the trajectory's time stamps
        clock: Callable[[], float] = time.monotonic,  # seconds
    ) -> None:
        """Open the file to append to it: a run that is resumed writes the frames it repeats once more."""
        self._offset = Decimal(time_offset)
        self._clock = clock
        self._synced = clock()
        self.problem = ""  # why the last writing failed; what was to be written waits for the next
        self._written: list[np.ndarray] = []  # [4, 4] by frame, the very arrays of the trajectory
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        size = os.fstat(self._file).st_size
        self._waiting = b"" if size else f"{HEADER}\n".encode()  # not in the file yet
        if size and os.pread(self._file, 1, size - 1) != b"\n":  # the process was killed in mid line
            self._waiting = b"\n"
        self._write()

    def begin_with(self, trajectory: Trajectory) -> None:
        """Take the poses of a trajectory as written: those of a checkpoint are in the file already."""
        self._written = [trajectory.pose(k) for k in range(len(trajectory))]

    def add(self, trajectory: Trajectory, converged: bool, message: str) -> None:
        """Write the newest pose, with what was said of it, and earlier ones that have been corrected."""
        self._add_corrections(trajectory)
        newest = len(trajectory) - 1
        self._add_line(trajectory, newest, str(int(converged)), message)
        self._written.append(trajectory.pose(newest))
        self._write()

    def correct(self, trajectory: Trajectory) -> None:
        """Write the poses that have been corrected, if the last writing to disk is a while ago."""
        if self._clock() - self._synced >= SYNC_EVERY:
            self._add_corrections(trajectory)
            self._write()

    def close(self, trajectory: Trajectory | None = None) -> None:
        """Write the poses of a trajectory that have been corrected, and close the file."""
        if self._file < 0:
            return
        try:
            if trajectory is not None:
                self._add_corrections(trajectory)
            self._write(is_last=True)
        finally:
            os.close(self._file)
            self._file = -1

    def _add_corrections(self, trajectory: Trajectory) -> None:
        # A corrected pose is another array: `Trajectory.replace` changes none in place.
        for k in trajectory.replaced(self._written):
            self._add_line(trajectory, k, "", "corrected")
            self._written[k] = trajectory.pose(k)

    def _add_line(self, trajectory: Trajectory, index: int, converged: str, message: str) -> None:
        T = trajectory.pose(index)
        stamp = Decimal(f"{trajectory.timestamp(index):.9f}") + self._offset
        values = [f"{v:.9f}" for v in (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())]
        line = io.StringIO()
        row = [index, f"{stamp:.9f}", *values, converged, plain(message, LONGEST_MESSAGE)]
        csv.writer(line, lineterminator="\n").writerow(row)
        self._waiting += line.getvalue().encode()

    def _write(self, is_last: bool = False) -> None:
        """Hand over what is waiting; what a full disk does not take waits for the next time."""
        try:
            while self._waiting:
                count = os.write(self._file, self._waiting)
                self._waiting = self._waiting[count:]
            if is_last or self._clock() - self._synced >= SYNC_EVERY:
                os.fsync(self._file)
                self._synced = self._clock()
            self.problem = ""
        except OSError as error:  # a journal that cannot be written is no reason to lose the run
            self.problem = error.strerror or str(error)


def read_journal(path: Path) -> Trajectory:
    """Read the path that a journal tells, in the recording's own time; lines that were cut off do not count.

    Raises `FileNotFoundError`, and `DataError` where there is no pose in it.
    """
    poses: dict[int, list[float]] = {}
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        for row in csv.reader(line.replace("\0", "") for line in file):
            if len(row) != HEADER.count(",") + 1 or row[0] == "frame":
                continue
            try:
                values = [float(word) for word in row[1:9]]
                index = int(row[0])
            except ValueError:
                continue
            if np.isfinite(values).all() and np.any(values[4:]):
                poses[index] = values
    if not poses:
        raise DataError(f"{path}: no pose in it yet")
    rows = np.array([poses[k] for k in sorted(poses)])
    rows = rows[np.concatenate([[True], np.diff(rows[:, 0]) > 0])]
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    matrices[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    matrices[:, :3, 3] = rows[:, 1:4]
    return Trajectory(rows[:, 0], matrices)
