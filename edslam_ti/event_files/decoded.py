"""Events of formats that must be decoded from the beginning, as a source of rows."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.event_files.rows import BLOCK, RowBlock
from edslam_ti.event_files.stream import Clock, RawEvents

LATEST_START = 1000.0  # s; stamps of later clocks are stored without their whole seconds

Parts = Iterator[tuple[RawEvents, float]]  # consecutive events, and the share of the file read so far


class DecodedRows:
    """Rows x, y, t [s], p of a decoder (`EventSource`)."""

    columns, counted = "xytp", "event"

    def __init__(
        self,
        path: Path,
        parts: Callable[["DecodedRows"], Parts],  # called for each reading, may add notes
        *,
        clock: Clock,
        most_events: int,
        part: str = "",  # which of several cameras
    ) -> None:
        self.path = path
        self.part = part
        self.name = f"{path} ({part})" if part else str(path)
        self.clock = clock
        self.notes: list[str] = []
        self.opening_notes: list[str] = []  # about the choice of the camera and its clock
        self._parts = parts
        self._most_events = most_events
        self._origin: float | None = None

    @property
    def origin(self) -> float:
        """Whole seconds that the stamps of `blocks` lack, so that late clocks lose no digits."""
        if self._origin is None:
            first = next((raw for raw, _ in self._parts(self) if len(raw)), None)
            if first is None:
                raise DataError(f"{self.name}: expected events, got none")
            seconds = float(self.clock.seconds(first.t[:1])[0])
            is_late = math.isfinite(seconds) and abs(seconds) > LATEST_START
            self._origin = float(math.floor(seconds)) if is_late else 0.0
        return self._origin

    def most_events(self) -> int:
        return self._most_events

    def column(self, index: int) -> str:
        return self.columns[index]

    def blocks(self) -> Iterator[RowBlock]:
        """Yield blocks of about `BLOCK` rows, however long the decoder's parts are."""
        origin = self.origin
        self.notes = []
        number, waiting, length = 0, list[np.ndarray](), 0
        share = 0.0
        for raw, share in self._parts(self):
            if len(raw):
                rows = np.empty((4, len(raw)))  # columns are contiguous
                rows[0], rows[1], rows[3] = raw.x, raw.y, raw.p
                rows[2] = self.clock.seconds(raw.t, origin)
                waiting.append(rows)
                length += len(raw)
            if length >= BLOCK:
                together = np.concatenate(waiting, 1) if len(waiting) > 1 else waiting[0]
                whole = length - length % BLOCK
                for start in range(0, whole, BLOCK):
                    rows = together[:, start : start + BLOCK]
                    yield RowBlock(rows.T, range(number, number + BLOCK), share=share)
                    number += BLOCK
                waiting, length = [together[:, whole:]], length - whole
        if length:
            yield RowBlock(np.concatenate(waiting, 1).T, range(number, number + length), share=1.0)

    def sample(self) -> np.ndarray:  # [S, 4] float64
        return next((block.rows for block in self.blocks()), np.empty((0, 4)))
