"""Prophesee's DAT files, read in place: a header, two bytes (type, size of an event), events of 8 bytes."""

from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.event_files.raw import PropheseeHeader
from edslam_ti.event_files.stream import Clock, RawEvents

EVENT = np.dtype([("t", "<u4"), ("address", "<u4")])
TYPES = (0x00, 0x0C)  # Event2D and CD
LOOK_EVERY = 1_000_000  # events; stamps begin again at 0 after 2^32 us, which takes more of them
TURN = 1 << 32  # us


class DatColumns:
    """Events of a DAT file; stamps go on after 71 minutes, when their 32 bits are used up."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name = str(path)
        self.notes: list[str] = []
        self.clock = Clock(1e6)
        header = PropheseeHeader(path)
        self.size = header.size()
        with path.open("rb") as file:
            file.seek(header.length)
            kind = file.read(2)
        start = header.length + 2
        if len(kind) < 2 or kind[0] not in TYPES or kind[1] != EVENT.itemsize:
            raise DataError(
                f"{path}: expected events of type 0 or 12 with {EVENT.itemsize} bytes, got "
                f"{' and '.join(str(byte) for byte in kind) or 'the end of the file'}"
            )
        self._length, rest = divmod(path.stat().st_size - start, EVENT.itemsize)
        if self._length == 0:
            raise DataError(f"{path}: expected events, got none")
        if rest:
            self.notes.append(f"the last event is cut off and left out ({rest} of {EVENT.itemsize} bytes)")
        self._start = start  # bytes
        self._turns = self._found_turns()

    def __len__(self) -> int:
        return self._length

    def read(self, start: int, end: int) -> RawEvents:
        rows = self._rows(start, end)
        address = np.ascontiguousarray(rows["address"])
        t = self._continued(rows["t"], start)
        polarity = ((address >> 28) & 1).astype(np.uint8)
        x, y = ((address >> shift & 0x3FFF).astype(np.uint16) for shift in (0, 14))
        return RawEvents(x, y, t, polarity)

    def times(self, start: int, end: int) -> np.ndarray:  # [M]
        return self._continued(self._rows(start, end)["t"], start)

    def near(self, seconds: float) -> int | None:
        return None

    def _rows(self, start: int, end: int) -> np.ndarray:  # [M] EVENT
        place = self._start + start * EVENT.itemsize
        return np.fromfile(self.path, EVENT, max(0, end - start), offset=place)

    def _stamp(self, event: int) -> int:
        return int(self._rows(event, event + 1)["t"][0])

    def _continued(self, stamps: np.ndarray, start: int) -> np.ndarray:  # [M] -> [M] int64
        if not self._turns:
            return stamps.astype(np.int64)
        turns = np.searchsorted(self._turns, np.arange(start, start + len(stamps)), side="right")
        return stamps.astype(np.int64) + TURN * turns

    def _found_turns(self) -> list[int]:
        """Return the events with which stamps begin again at 0."""
        places = np.append(np.arange(0, self._length, LOOK_EVERY), self._length - 1)
        stamps = np.array([self._stamp(int(place)) for place in places])
        turns = []
        for k in np.flatnonzero(np.diff(stamps) < -TURN // 2):
            first, last = int(places[k]), int(places[k + 1])
            while last - first > 1:
                middle = (first + last) // 2
                is_before = self._stamp(middle) > TURN // 2
                first, last = (middle, last) if is_before else (first, middle)
            turns.append(last)
        return turns


def is_dat(path: Path) -> bool:
    """Return whether a file with Prophesee's header is a DAT file: it states no encoding of words."""
    header = PropheseeHeader(path)
    return header.encoding() is None and ("data" in header.values or path.suffix.lower() == ".dat")
