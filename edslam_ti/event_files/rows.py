"""Reads events of an `.npy` array in blocks of rows, in the file's own order of columns."""

import tokenize
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np

from edslam_ti.errors import DataError

BLOCK = 131_072  # rows; with four float64 each they fit in a core's cache
PROBES = 32  # pieces of PROBE_LENGTH rows from which the order of columns and the unit of time are detected
PROBE_LENGTH = 2048
LONGEST_REASON = 200  # characters of another library's message
FIELD_NAMES = {  # of structured arrays
    "x": ("x",),
    "y": ("y",),
    "t": ("t", "ts", "time", "timestamp"),
    "p": ("p", "pol", "polarity"),
}


@dataclass(frozen=True)
class RowBlock:
    """Consecutive rows."""

    rows: np.ndarray  # [N, 4] of any floating type
    numbers: Sequence[int]  # [N] number of each row in the user's own file
    unreadable: dict[int, str] = field(default_factory=dict)  # text of rows that are not four numbers
    share: float = 0.0  # of the file that has been read, 0 to 1


class EventSource(Protocol):
    """A file of events with four numbers each."""

    path: Path  # a file, or the folder of a recording
    name: str  # of the user's own file
    part: str  # of the file: one of several cameras; empty where a file holds one
    columns: str  # the expected order, such as "xytp"
    counted: str  # unit in messages: "row", "line" or "event"
    notes: list[str]  # sentences for the user about the last reading

    @property
    def origin(self) -> float:
        """Seconds that are to be added to the stamps of `blocks`."""

    def most_events(self) -> int:
        """Return about how many events there are, rather too many."""

    def blocks(self) -> Iterator[RowBlock]:
        """Yield all rows in the order of the file."""

    def sample(self) -> np.ndarray:  # [S, 4] float64
        """Return representative rows of the file, in its order."""

    def column(self, index: int) -> str:
        """Return a column's name in messages."""


@dataclass(frozen=True)
class _Layout:
    """Position and type of the array in the file."""

    dtype: np.dtype
    num_rows: int
    fortran_order: bool
    offset: int  # bytes
    fields: tuple[str, ...] = ()  # of a structured array: those that hold x, y, t, p

    @property
    def row_bytes(self) -> int:
        return self.dtype.itemsize * (1 if self.fields else 4)


class NpyRows:
    """Rows of an array [N, 4], or of a structured array [N] with fields x, y, t, p."""

    part, columns, counted, origin = "", "xytp", "row", 0.0

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name = str(path)
        self.notes: list[str] = []
        self._layout = _read_layout(path)
        if len(self) == 0:
            raise DataError(f"{path}: expected events, got an empty array")

    def __len__(self) -> int:
        return self._layout.num_rows

    def most_events(self) -> int:
        return len(self)

    def column(self, index: int) -> str:
        fields = self._layout.fields
        return f"field '{fields[index]}'" if fields else f"column [:, {index}]"

    def rows(self, start: int, end: int) -> np.ndarray:  # [M, 4]
        """Return the rows start to end."""
        layout, number = self._layout, min(end, len(self)) - start
        with self.path.open("rb") as file:
            if layout.fortran_order:
                parts = [self._read(file, k * len(self) + start, number, layout.dtype) for k in range(4)]
                return np.stack(parts, 1)
            if layout.fields:
                table = self._read(file, start, number, layout.dtype)
                return np.stack([table[name].astype(np.float64) for name in layout.fields], 1)
            return self._read(file, 4 * start, 4 * number, layout.dtype).reshape(number, 4)

    def _read(self, file: BinaryIO, first: int, count: int, dtype: np.dtype) -> np.ndarray:
        file.seek(self._layout.offset + first * dtype.itemsize)
        values = np.fromfile(file, dtype, count)
        if len(values) != count:
            raise DataError(f"{self.name}: became shorter while it was read; copy or download it again")
        return values

    def blocks(self) -> Iterator[RowBlock]:
        for start in range(0, len(self), BLOCK):
            rows = self.rows(start, start + BLOCK)
            end = start + len(rows)
            yield RowBlock(rows, range(start, end), share=end / len(self))

    def sample(self) -> np.ndarray:  # [S, 4] float64
        if len(self) <= PROBES * PROBE_LENGTH:
            return self.rows(0, len(self)).astype(np.float64)
        starts = np.linspace(0, len(self) - PROBE_LENGTH, PROBES).astype(np.int64)
        parts = [self.rows(int(start), int(start) + PROBE_LENGTH) for start in starts]
        return np.concatenate(parts).astype(np.float64)


def _read_layout(path: Path) -> _Layout:
    """Read the header of the .npy file and check it against the file's size."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: event file not found")
    size = path.stat().st_size
    if size == 0:
        raise DataError(f"{path}: the file is empty; expected a NumPy array of events (N, 4): x, y, t [s], p")
    shape, fortran_order, dtype, offset = _read_header(path)
    if not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
        raise DataError(f"{path}: expected an (N, 4) array, got a header with shape {str(shape)[:50]}")
    fields = _fields(path, dtype) if dtype.names is not None and len(shape) == 1 else ()
    if not fields:
        if dtype.hasobject or dtype.kind not in "fiub":
            raise DataError(
                f"{path}: expected an (N, 4) array of numbers x, y, t [s], p; got element type "
                f"{str(dtype)[:LONGEST_REASON]}"
            )
        if len(shape) != 2 or shape[1] != 4:
            hint = "; save its transpose" if len(shape) == 2 and shape[0] == 4 else ""
            raise DataError(
                f"{path}: expected an (N, 4) array with columns x, y, t [s], p; got shape {shape}{hint}"
            )
        if dtype.kind in "iub":
            raise DataError(
                f"{path}: expected times in seconds, which {dtype} cannot hold; save the array as float64"
            )
    layout = _Layout(dtype, shape[0], bool(fortran_order) and not fields, offset, fields)
    expected = offset + shape[0] * layout.row_bytes
    if size < expected:
        raise DataError(
            f"{path}: truncated: the header states {shape[0]} events ({expected} bytes), the file has "
            f"{size} bytes, {max(0, size - offset) // layout.row_bytes} events; copy or download it again"
        )
    return layout


def _read_header(path: Path) -> tuple[tuple[int, ...], bool, np.dtype, int]:
    """Return shape, whether columns come first, type and offset in bytes."""
    with path.open("rb") as file:
        try:
            version = np.lib.format.read_magic(file)
            read = (
                np.lib.format.read_array_header_1_0
                if version == (1, 0)
                else np.lib.format.read_array_header_2_0
            )
            return *read(file), file.tell()
        except (
            # Besides its own ValueError, numpy lets these errors of its header's parser through.
            *(ValueError, OSError, SyntaxError, TypeError, tokenize.TokenError),
            *(RecursionError, MemoryError, OverflowError, EOFError),
        ) as error:
            reason = " ".join(str(error).split())[:LONGEST_REASON]
            raise DataError(f"{path}: not readable as a NumPy .npy file ({reason})") from error


def _fields(path: Path, dtype: np.dtype) -> tuple[str, ...]:
    """Return the names of the fields that hold x, y, t, p."""
    fields: Mapping[str, Any] = dtype.fields or {}
    found = []
    for names in FIELD_NAMES.values():
        matching = [name for name in fields if name.lower() in names]
        if len(matching) != 1 or fields[matching[0]][0].kind not in "fiub":
            there = ", ".join(fields)[:LONGEST_REASON]
            raise DataError(f"{path}: expected fields x, y, t [s], p of numbers, got fields {there}")
        found.append(matching[0])
    if fields[found[2]][0].kind != "f":
        raise DataError(
            f"{path}: expected times in seconds, which field '{found[2]}' of type {fields[found[2]][0]} "
            "cannot hold; save it as float64"
        )
    return tuple(found)


def named_columns(names: Iterable[str]) -> dict[str, str]:
    """Return which names mean x, y, t and p, by letter; empty: one is missing or doubtful."""
    names, result = list(names), {}
    for letter, meanings in FIELD_NAMES.items():
        matching = [name for name in names if name.lower() in (*meanings, f"{letter}s")]
        if len(matching) != 1:
            return {}
        result[letter] = matching[0]
    return result
