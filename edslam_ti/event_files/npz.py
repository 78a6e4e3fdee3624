"""Events in `.npz` archives: arrays x, y, t, p, or one array `events` [N, 4] or with these fields.

Members are decompressed piece by piece.
"""

import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np

from edslam_ti.errors import DataError, plain
from edslam_ti.event_files.checks import LARGEST_SIZE, detected_order
from edslam_ti.event_files.decoded import DecodedRows, Parts
from edslam_ti.event_files.rows import BLOCK, named_columns
from edslam_ti.event_files.stream import RawEvents
from edslam_ti.event_files.units import EDGE, clock_of


class _Member:
    """One array of the archive."""

    def __init__(self, path: Path, name: str) -> None:
        self._path, self._name = path, name
        with zipfile.ZipFile(path) as archive, archive.open(name) as file:
            self.shape, self.dtype, self.is_fortran = _header(file)

    def pieces(self) -> Iterator[np.ndarray]:
        """Yield `BLOCK` rows after the other."""
        if self.is_fortran and len(self.shape) > 1:
            with np.load(self._path, allow_pickle=False) as archive:
                whole = archive[self._name.removesuffix(".npy")]
            yield from (whole[start : start + BLOCK] for start in range(0, len(whole), BLOCK))
            return
        row = self.dtype.itemsize * int(np.prod(self.shape[1:], dtype=int))
        with zipfile.ZipFile(self._path) as archive, archive.open(self._name) as file:
            _header(file)
            for start in range(0, self.shape[0], BLOCK):
                number = min(BLOCK, self.shape[0] - start)
                data = file.read(number * row)
                if len(data) < number * row:
                    raise EOFError(f"{self._name} ends before its row {self.shape[0]}")
                yield np.frombuffer(data, self.dtype).reshape(number, *self.shape[1:])


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype, bool]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, is_fortran, dtype = read(file)
    return shape, dtype, is_fortran


class _Edges:
    """The first and the last stamps of a column, from which its unit is detected."""

    def __init__(self, pieces: Iterator[np.ndarray]) -> None:
        self._first = self._last = np.empty(0)
        for piece in pieces:
            self._first = self._first if len(self._first) else piece[:EDGE]
            self._last = piece[-EDGE:]

    def __len__(self) -> int:
        return 2 * EDGE

    def times(self, start: int, end: int) -> np.ndarray:
        return self._first if start == 0 else self._last


def npz_rows(path: Path, size: tuple[int, int] | None) -> DecodedRows:
    """Return the events of an archive; raises `DataError` where it holds none."""
    with _one_line(path):
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if name.endswith(".npy")]
        members = {name.removesuffix(".npy"): _Member(path, name) for name in names}
        stamps, read, number = _layout(path, members, size)
        clock = clock_of(_Edges(stamps()), f"{path}: t")

    def parts(rows: DecodedRows) -> Parts:
        done = 0
        with _one_line(path):
            for raw in read():
                done += len(raw)
                yield raw, done / number

    return DecodedRows(path, parts, clock=clock, most_events=number)


Stamps = Callable[[], Iterator[np.ndarray]]
Read = Callable[[], Iterator[RawEvents]]


def _layout(
    path: Path, members: dict[str, _Member], size: tuple[int, int] | None
) -> tuple[Stamps, Read, int]:
    """Return functions that read the stamps and the events, and the number of events."""
    columns = {name: member for name, member in members.items() if len(member.shape) == 1}
    if names := named_columns(columns):
        chosen = {letter: columns[name] for letter, name in names.items()}
        lengths = {name: columns[name].shape[0] for name in names.values()}
        if len(set(lengths.values())) > 1:
            there = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise DataError(f"{path}: expected arrays of one length, got {there}")
        if any(member.dtype.kind not in "fiub" for member in chosen.values()):
            raise DataError(f"{path}: expected arrays of numbers x, y, t, p")

        def read() -> Iterator[RawEvents]:
            for pieces in zip(*(chosen[letter].pieces() for letter in "xytp")):
                yield RawEvents(*pieces)

        return chosen["t"].pieces, read, max(1, chosen["t"].shape[0])
    for member in members.values():
        if len(member.shape) == 1 and (fields := named_columns(member.dtype.names or ())):
            return *_table(member, fields), max(1, member.shape[0])
        if len(member.shape) == 2 and member.shape[1] == 4 and member.dtype.kind in "fiu":
            first = next(member.pieces(), np.empty((0, 4))).astype(np.float64)
            if len(first) and (order := detected_order(first, "xytp", size or LARGEST_SIZE)):
                return *_table(member, {letter: order.index(letter) for letter in "xytp"}), member.shape[0]
    there = ", ".join(f"{name} {member.shape}" for name, member in members.items())
    raise DataError(
        f"{path}: expected arrays x, y, t, p, or one of events [N, 4], got {plain(there) or 'none'}"
    )


def _table(member: _Member, places: dict[str, str] | dict[str, int]) -> tuple[Stamps, Read]:
    """Return the functions that read the stamps and the events of a table."""

    def column(rows: np.ndarray, letter: str) -> np.ndarray:
        place = places[letter]
        return rows[:, place] if isinstance(place, int) else rows[place]

    def read() -> Iterator[RawEvents]:
        for rows in member.pieces():
            yield RawEvents(**{letter: column(rows, letter) for letter in "xytp"})

    return lambda: (column(rows, "t") for rows in member.pieces()), read


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Turn what NumPy and zipfile raise into one line."""
    try:
        yield
    except DataError:
        raise
    except (
        *(zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, SyntaxError, TypeError),
        *(NotImplementedError, RuntimeError),
    ) as error:
        raise DataError(
            f"{path}: not readable as a NumPy .npz archive ({plain(error)}); copy or download it again"
        ) from error
