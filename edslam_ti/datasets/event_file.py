"""Events in one `.npy` array of rows (x, y, t, p), read slice by slice however large the file is."""

from bisect import bisect_left
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.events import Events

DISORDER = 5e-3  # s: simulators sort in blocks of 1 ms or so, not globally (gray_events_data.npy)
LONGEST_RECORDING = 2e5  # s: a longer span means that the stamps are not in seconds
PROBES = 32  # blocks of PROBE_LENGTH rows looked at when a file is opened
PROBE_LENGTH = 2048


@dataclass(frozen=True)
class _Layout:
    """Where the array lies in the file."""

    dtype: np.dtype
    shape: tuple[int, int]
    fortran_order: bool
    offset: int  # bytes


class EventFile:
    """Rows (x, y, t, p): pixel column, pixel row, seconds, polarity in {-1, +1} or {0, 1}.

    A slice maps the file afresh and copies out what it needs, so that the pages it touched leave the
    process with it: resident memory does not grow with the file or with the number of slices. Stamps
    may be out of order by up to `DISORDER`; slices come out sorted and exact.

    `shift` seconds are subtracted from every stamp. `name` and `first_row` are for messages only: the
    file the user knows and the number it gives to the first row.
    """

    def __init__(
        self,
        path: Path,
        width: int,
        height: int,
        name: str | None = None,
        first_row: int = 0,
        shift: float = 0.0,
    ) -> None:
        self.path = path
        self.name = name or str(path)
        self.first_row = first_row
        self.shift = shift
        self._size = (width, height)
        self._layout = _read_layout(path, self.name)
        self._negative: float | None = None  # what the file writes for polarity -1: -1 or 0
        self._first, self._last = self._probe()  # s, as stored

    def __len__(self) -> int:
        return self._layout.shape[0]

    @property
    def time_range(self) -> tuple[float, float]:
        """Times of the first and the last event in seconds, shifted."""
        return self._first - self.shift, self._last - self.shift

    def shifted(self, shift: float) -> "EventFile":
        """Return the same events on a clock whose zero is at stamp `shift`."""
        width, height = self._size
        return EventFile(self.path, width, height, self.name, self.first_row, shift)

    def between(self, start: float, end: float) -> Events:
        """Return the events with start <= t < end, sorted by time (stable)."""
        start, end = start + self.shift, end + self.shift
        if not end > start:
            return Events.empty()
        with self._mapped() as rows:
            times = rows[:, 2]
            # With every stamp within DISORDER of the running maximum, no event of [start, end) lies
            # before the first index or behind the second.
            i = bisect_left(times, start - DISORDER)
            j = bisect_left(times, end + DISORDER, lo=i)
            x, y, t, polarity = self._checked(rows, i, j)
        in_order = bool((t[1:] >= t[:-1]).all())
        if in_order:
            a, b = np.searchsorted(t, [start, end])
            kept: slice | np.ndarray = slice(int(a), int(b))
        else:
            kept = np.flatnonzero((t >= start) & (t < end))
            kept = kept[np.argsort(t[kept], kind="stable")]
        t = t[kept]
        if self.shift:
            t = t - self.shift
        return Events(*(np.ascontiguousarray(a) for a in (x[kept], y[kept], t, polarity[kept])))

    @contextmanager
    def _mapped(self) -> Iterator[np.ndarray]:  # [N, 4]
        """Map the file for the length of a block; whatever leaves the block must be a copy."""
        layout = self._layout
        if layout.shape[0] == 0:
            yield np.empty(layout.shape, layout.dtype)
            return
        mapped: np.ndarray = np.memmap(
            self.path,
            layout.dtype,
            mode="r",
            offset=layout.offset,
            shape=layout.shape,
            order="F" if layout.fortran_order else "C",
        )
        yield mapped.view(np.ndarray)

    def _checked(
        self, rows: np.ndarray, i: int, j: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return x, y, t, polarity of rows i to j as copies; every value is looked at."""
        block = rows[i:j]
        t = block[:, 2].astype(np.float64)
        with np.errstate(invalid="ignore"):  # NaN to int: caught by the comparison below
            x, y = block[:, 0].astype(np.int16), block[:, 1].astype(np.int16)
        width, height = self._size
        good = (x == block[:, 0]) & (x >= 0) & (x < width) & (y == block[:, 1]) & (y >= 0) & (y < height)
        if not good.all():
            self._refuse(rows, i + int(good.argmin()), f"x in 0 to {width - 1} and y in 0 to {height - 1}")
        if not np.isfinite(t).all():
            self._refuse(rows, i + int(np.isfinite(t).argmin()), "a finite time in seconds")
        backward = np.maximum.accumulate(t) - t
        if len(t) and backward.max() > DISORDER:
            worst = int(backward.argmax())
            self._refuse(
                rows,
                i + worst,
                f"stamps in order to within {1000 * DISORDER:g} ms (this one is "
                f"{backward[worst]:.6g} s before an earlier row; sort the events by time)",
            )
        positive = block[:, 3] == 1
        others = block[:, 3][~positive]
        if len(others):
            if self._negative is None and others[0] in (-1, 0):
                self._negative = float(others[0])
            if self._negative is None or not (others == self._negative).all():
                bad = ~positive & (True if self._negative is None else block[:, 3] != self._negative)
                self._refuse(rows, i + int(np.argmax(bad)), "polarity -1 or +1 (or 0 or 1) throughout")
        polarity = np.where(positive, np.int8(1), np.int8(-1))
        return x, y, t, polarity

    def _refuse(self, rows: np.ndarray, row: int, expected: str) -> None:
        values = ", ".join(f"{float(v):.10g}" for v in rows[row])
        raise DataError(
            f"{self.name}: row {row + self.first_row}: expected {expected}, got x, y, t, p = {values} "
            f"(image {self._size[0]}x{self._size[1]}, times in seconds)"
        )

    def _probe(self) -> tuple[float, float]:
        """Look at blocks spread over the file; return the first and the last time."""
        count = len(self)
        if count == 0:
            raise DataError(f"{self.name}: expected events, got an empty array of shape {self._layout.shape}")
        starts = np.linspace(0, max(0, count - PROBE_LENGTH), PROBES).astype(np.int64)
        first = last = float("nan")
        seen = 0  # rows before this have been looked at, so that blocks of a small file do not overlap
        with self._mapped() as rows:
            ends = rows[[0, -1], 2].astype(np.float64)
            if np.isfinite(ends).all() and abs(ends[1] - ends[0]) > LONGEST_RECORDING:
                raise DataError(
                    f"{self.name}: expected times in seconds, got {ends[0]:.10g} to {ends[1]:.10g}, "
                    f"{(ends[1] - ends[0]) / 86400:.3g} days of recording; these look like micro- or "
                    "nanoseconds: divide column 2 by 1e6 or 1e9"
                )
            for start in starts:
                begin, seen = max(int(start), seen), min(int(start) + PROBE_LENGTH, count)
                if begin >= seen:
                    continue
                _, _, t, _ = self._checked(rows, begin, seen)
                if t.min() < last - DISORDER:
                    expected = f"times in order (earlier rows reach {last:.6f} s; sort the events)"
                    self._refuse(rows, begin + int(t.argmin()), expected)
                first, last = float(np.fmin(first, t.min())), float(np.fmax(last, t.max()))
        return first, last


def _read_layout(path: Path, name: str) -> _Layout:
    """Read the header of the .npy file and check it against the file's size."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: event file not found")
    size = path.stat().st_size
    if size == 0:
        raise DataError(f"{name}: the file is empty; expected a NumPy array of events (N, 4): x, y, t [s], p")
    with path.open("rb") as file:
        try:
            version = np.lib.format.read_magic(file)
            read_header = (
                np.lib.format.read_array_header_1_0
                if version == (1, 0)
                else np.lib.format.read_array_header_2_0
            )
            shape, fortran_order, dtype = read_header(file)
        except (ValueError, OSError, SyntaxError) as error:
            raise DataError(
                f"{name}: not readable as a NumPy .npy file ({' '.join(str(error).split())})"
            ) from error
        offset = file.tell()
    if dtype.hasobject or dtype.kind not in "fiub":
        raise DataError(
            f"{name}: expected an (N, 4) array of numbers x, y, t [s], p; got element type {dtype}"
        )
    if len(shape) != 2 or shape[1] != 4:
        raise DataError(f"{name}: expected an (N, 4) array with columns x, y, t [s], p; got shape {shape}")
    if dtype.kind in "iub":
        raise DataError(
            f"{name}: expected times in seconds, which {dtype} cannot hold; save the array as float64"
        )
    expected = offset + shape[0] * 4 * dtype.itemsize
    if size < expected:
        raise DataError(
            f"{name}: truncated: the header promises {shape[0]} events ({expected} bytes), the file has "
            f"{size} bytes, {max(0, size - offset) // (4 * dtype.itemsize)} events; copy or download it again"
        )
    return _Layout(dtype, (shape[0], 4), fortran_order, offset)
