"""What readers of events have in common: the stream that others use, and the columns that formats give."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, Self

import numpy as np

from edslam_ti.events import Events

Progress = Callable[[float], None]  # receives the share done, 0 to 1


class EventStream(Protocol):
    """The sorted events of one camera, read slice by slice."""

    path: Path

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the image as the file states them; None: it does not."""

    @property
    def num_dropped(self) -> int:
        """Number of bad events that were left out in what has been read so far."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user: what is unusual, and what was left out so far."""

    def __len__(self) -> int:
        """Return the number of events. Where all have been read, bad ones are not counted."""

    @property
    def time_range(self) -> tuple[float, float]:
        """Times of the first and the last event, seconds of the file's own clock, shifted."""

    def shifted(self, shift: float) -> Self:
        """Return the same events on a clock whose zero is at stamp `shift` (s)."""

    def between(self, start: float, end: float) -> Events:
        """Return the events with start <= t < end, sorted by time (stable) and checked."""


@dataclass(frozen=True)
class RawEvents:
    """Consecutive events with the file's own numbers; all arrays have length N."""

    x: np.ndarray  # [N] any type of number, as all arrays here
    y: np.ndarray  # [N]
    t: np.ndarray  # [N] in the unit of the file's clock
    p: np.ndarray  # [N]

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True)
class Clock:
    """Turns a file's numbers for time into seconds."""

    ticks: float = 1.0  # per second
    offset: int = 0  # ticks, added to every number

    def seconds(self, numbers: np.ndarray, shift: float = 0.0) -> np.ndarray:  # [N] -> [N] float64
        """Return seconds since `shift`.

        Whole ticks are subtracted before the division, so that stamps since the epoch lose nothing when
        they are shifted.
        """
        whole = round(shift * self.ticks)
        if numbers.dtype.kind == "f":
            seconds = numbers.astype(np.float64) if self.ticks == 1 else numbers / np.float64(self.ticks)
            return seconds - (shift - self.offset / self.ticks) if shift or self.offset else seconds
        rest = shift - whole / self.ticks
        if self.offset == whole:
            seconds = numbers / np.float64(self.ticks)
        else:
            seconds = (numbers.astype(np.int64) + (self.offset - whole)) / np.float64(self.ticks)
        return seconds - rest if abs(rest) > 1e-12 * abs(shift) else seconds


class EventColumns(Protocol):
    """A file whose events can be read at any place without conversion."""

    path: Path
    name: str  # file and place in it, for messages
    size: tuple[int, int] | None  # width and height that the file states
    clock: Clock
    notes: list[str]  # sentences for the user

    def __len__(self) -> int: ...

    def read(self, start: int, end: int) -> RawEvents:
        """Return the events start to end."""

    def times(self, start: int, end: int) -> np.ndarray:  # [M]
        """Return the numbers for time of the events start to end."""

    def near(self, seconds: float) -> int | None:
        """Return about which event happened at a time; None: the file has no index."""
