"""Inertial measurements of a recording."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.tables import read_table, text_lines

HEADER_LINES = 3  # at the top of a text file that may hold words


@dataclass(frozen=True)
class ImuData:
    """Angular velocity and acceleration in the frame of the sensor, as the files have them."""

    timestamps: np.ndarray  # [N] seconds, strictly increasing, on the sequence's clock
    angular_velocity: np.ndarray  # [N, 3] rad/s
    acceleration: np.ndarray  # [N, 3] m/s^2, gravity included

    def __post_init__(self) -> None:
        shapes = (self.timestamps.shape, self.angular_velocity.shape, self.acceleration.shape)
        n = len(self.timestamps)
        if shapes != ((n,), (n, 3), (n, 3)):
            raise DataError(f"IMU: expected shapes [N], [N, 3] and [N, 3], got {shapes}")

    def __len__(self) -> int:
        return len(self.timestamps)

    def shifted(self, shift: float) -> "ImuData":
        """Return the same measurements on a clock whose zero is at stamp `shift` (s)."""
        return ImuData(self.timestamps - shift, self.angular_velocity, self.acceleration)


def in_order(
    times: np.ndarray,  # [N] s
    angular_velocity: np.ndarray,  # [N, 3] rad/s
    acceleration: np.ndarray,  # [N, 3] m/s^2
) -> ImuData:
    """Return measurements sorted by time, without repeated stamps and without values that are not finite."""
    good = np.isfinite(times) & np.isfinite(angular_velocity).all(1) & np.isfinite(acceleration).all(1)
    good = np.flatnonzero(good)
    _, first = np.unique(times[good], return_index=True)
    kept = good[first]
    return ImuData(times[kept], angular_velocity[kept], acceleration[kept])


def read_imu_text(path: Path, columns: int | tuple[int, ...], line: str, ticks: float = 1.0) -> ImuData:
    """Return a text of lines 't gx gy gz ax ay az ...' of `columns` numbers, `ticks` of t in a second.

    Several numbers of columns mean that any of them is accepted.
    """
    choices = (columns,) if isinstance(columns, int) else columns
    last = ""
    for number, text in text_lines(path, f"expected lines '{line}'"):
        last = text
        if number > HEADER_LINES:
            break
    number = len(last.split())
    rows = read_table(path, number if number in choices else choices[-1], line, HEADER_LINES).rows
    return in_order(rows[:, 0] / ticks, rows[:, 1:4], rows[:, 4:7])
