"""A slice of an event stream as four parallel arrays."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from edslam_ti.errors import DataError


@dataclass(frozen=True)
class Events:
    """Events sorted by time (ties allowed); all arrays have the same length N and are contiguous."""

    x: np.ndarray  # [N] int16, column
    y: np.ndarray  # [N] int16, row
    t: np.ndarray  # [N] float64, seconds from the start of the sequence
    polarity: np.ndarray  # [N] int8, -1 or +1

    def __post_init__(self) -> None:
        lengths = {len(a) for a in (self.x, self.y, self.t, self.polarity)}
        if len(lengths) != 1:
            raise DataError(f"events: expected arrays of one length, got {sorted(lengths)}")

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, kept: slice | np.ndarray) -> "Events":
        """Return the events of a slice (views), or of indices or a mask in order of time (copies)."""
        return Events(self.x[kept], self.y[kept], self.t[kept], self.polarity[kept])

    def pieces(self, length: int) -> Iterator["Events"]:
        """Yield the events in pieces of at most `length`, so that results per piece need little memory."""
        return (self[start : start + length] for start in range(0, len(self), length))

    @staticmethod
    def empty() -> "Events":
        """Return a slice without events."""
        return Events(np.empty(0, np.int16), np.empty(0, np.int16), np.empty(0), np.empty(0, np.int8))

    def between(self, start: float, end: float) -> "Events":
        """Return the events with start <= t < end (views, not copies)."""
        i, j = np.searchsorted(self.t, [start, end])
        return self[i:j]

    @staticmethod
    def concatenate(parts: list["Events"]) -> "Events":
        """Return consecutive slices as one."""
        if not parts:
            return Events.empty()
        if len(parts) == 1:
            return parts[0]
        return Events(*(np.concatenate([getattr(p, f) for p in parts]) for f in ("x", "y", "t", "polarity")))
