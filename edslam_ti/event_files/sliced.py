"""Reads slices of files that are never converted, and checks each when it is read.

Opening looks at a few places: the ends, and some pieces between them. Events are then read in blocks, of
which a few are kept. Bad events are left out and counted; too many of them are refused.
"""

import copy
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.event_files.checks import (
    DISORDER,
    MOST_BAD,
    NEIGHBOURS,
    WINDOW,
    BadRows,
    Columns,
    EventChecker,
    bad_rows_note,
    negative_polarity,
)
from edslam_ti.event_files.rows import BLOCK, PROBE_LENGTH, PROBES, RowBlock
from edslam_ti.event_files.stream import EventColumns, RawEvents
from edslam_ti.events import Events

AT_OPENING = 2_000_000  # events; all of a shorter recording are checked when it is opened
KEPT = 4  # blocks
MARGIN = 2 * DISORDER  # s; events further before or after a place in the file are not beyond it


class SlicedEvents:
    """Sorted events of columns; implements `EventStream`."""

    def __init__(self, columns: EventColumns, size: tuple[int, int]) -> None:
        """`size` is the image's; raises `DataError` for events that cannot be right."""
        self.path: Path = columns.path
        self.size = columns.size
        self._columns = columns
        self._blocks = _Blocks(columns, size)
        self._shift = 0.0

    @property
    def num_dropped(self) -> int:
        """Number of bad events in the blocks that have been read."""
        return self._blocks.bad.number

    @property
    def notes(self) -> tuple[str, ...]:
        bad = bad_rows_note(self._blocks.bad, self._blocks.num_read, "event")
        return (*self._columns.notes, *bad)

    def __len__(self) -> int:
        return len(self._columns) - self.num_dropped

    @property
    def time_range(self) -> tuple[float, float]:
        """Times of the first and the last event in seconds, shifted."""
        first, last = self._columns.clock.seconds(self._blocks.ends, self._shift)
        return float(first), float(last)

    def shifted(self, shift: float) -> "SlicedEvents":
        """Return the same events on a clock whose zero is at stamp `shift`; blocks are shared."""
        result = copy.copy(self)
        result._shift = shift
        return result

    def between(self, start: float, end: float) -> Events:
        """Return the events with start <= t < end, sorted by time (stable)."""
        if not end > start:
            return Events.empty()
        parts = list(self._blocks.between(start + self._shift, end + self._shift))
        if not parts:
            return Events.empty()
        x, y, t, p = (np.concatenate([getattr(part, name) for part in parts]) for name in "xytp")
        seconds = self._columns.clock.seconds(t, self._shift)
        if not (seconds[1:] >= seconds[:-1]).all():
            backward = np.maximum.accumulate(seconds) - seconds
            if (worst := float(backward.max())) > DISORDER:
                raise DataError(
                    f"{self._columns.name}: expected stamps in order to within {1000 * DISORDER:g} ms, got "
                    f"one {worst:.6g} s before an earlier event near {start:.6g} s; sort the events by time"
                )
            order = np.argsort(seconds, kind="stable")
            x, y, seconds, p = x[order], y[order], seconds[order], p[order]
        return Events(x, y, seconds, p).between(start, end)


class _ColumnRows:
    """The same events as rows x, y, t [s], p, for `EventChecker` (`EventSource`)."""

    part, columns, counted, origin = "", "xytp", "event", 0.0

    def __init__(self, columns: EventColumns) -> None:
        self.path = columns.path
        self.name = columns.name
        self.notes: list[str] = []
        self._columns = columns

    def most_events(self) -> int:
        return len(self._columns)

    def column(self, index: int) -> str:
        return self.columns[index]

    def block(self, start: int, end: int) -> RowBlock:
        """Return the rows start to end, as far as there are any."""
        start, end = max(0, start), min(end, len(self._columns))
        raw = self._columns.read(start, end)
        seconds = self._columns.clock.seconds(raw.t)
        return RowBlock(np.stack([raw.x, raw.y, seconds, raw.p], 1, dtype=np.float64), range(start, end))

    def blocks(self) -> Iterator[RowBlock]:
        for start in range(0, len(self._columns), BLOCK):
            yield self.block(start, start + BLOCK)

    def sample_block(self) -> RowBlock:
        number = len(self._columns)
        starts = np.linspace(0, max(0, number - PROBE_LENGTH), min(PROBES, -(-number // PROBE_LENGTH)))
        parts = [self.block(int(start), int(start) + PROBE_LENGTH) for start in starts]
        numbers = np.concatenate([np.asarray(part.numbers) for part in parts])
        numbers, kept = np.unique(numbers, return_index=True)
        return RowBlock(np.concatenate([part.rows for part in parts])[kept], numbers.tolist())

    def sample(self) -> np.ndarray:  # [S, 4] float64
        return self.sample_block().rows


class _Blocks:
    """Blocks of `BLOCK` events, checked; the last few are kept."""

    def __init__(self, columns: EventColumns, size: tuple[int, int]) -> None:
        self._columns = columns
        self._size = size
        self._rows = _ColumnRows(columns)
        self._number = -(-len(columns) // BLOCK)
        self._kept: OrderedDict[int, RawEvents] = OrderedDict()
        self._starts: dict[int, tuple[float, float]] = {}  # s, median and least stamp where a block begins
        self._bad_of: dict[int, int] = {}  # number of bad events of each block that has been read
        self.bad = BadRows()
        self.num_read = 0
        sample = self._rows.sample_block()
        self._meaning = Columns("xytp", negative_polarity(sample.rows[:, 3]))
        checker = EventChecker(self._rows, size, self._meaning)
        checker.check(sample, None)
        checker.end()
        self._oldest: float | None = None
        first, last = self._block(0), self._block(self._number - 1)
        if len(columns) <= AT_OPENING:
            for k in range(self._number):
                self._block(k)
            self._refuse_many(self.num_read)
        if len(first) == 0 or len(last) == 0:
            raise DataError(f"{columns.name}: expected events, got none that is good at one end")
        self.ends = np.array([first.t.min(), last.t.max()])  # first and last stamp, unit of the file

    def between(self, start: float, end: float) -> Iterator[RawEvents]:
        """Yield the blocks in which events with start <= t < end (s) may be."""
        # Disorder may put them into the neighbouring blocks.
        first = max(0, self._first_from(start - MARGIN) - 1)
        last = self._first_from(end + MARGIN)
        if last < self._number and self._start(last)[1] < end:
            last += 1
        for k in range(first, last):
            part = self._block(k)
            if len(part):
                yield part

    def _first_from(self, seconds: float) -> int:
        """Return the first block that begins at a time or later; the number of blocks: none does."""
        before, found = -1, self._number  # the block is later than one and not later than the other
        near = self._columns.near(seconds)
        guesses = [] if near is None else [near // BLOCK, near // BLOCK + 1]
        while found - before > 1:
            k = guesses.pop(0) if guesses else (before + found) // 2
            if before < k < found:
                if self._start(k)[0] >= seconds:
                    found = k
                else:
                    before = k
        return found

    def _start(self, k: int) -> tuple[float, float]:
        if k not in self._starts:
            first = k * BLOCK
            stamps = self._columns.times(first, min(first + NEIGHBOURS + 1, len(self._columns)))
            seconds = self._columns.clock.seconds(stamps)
            seconds = seconds[np.isfinite(seconds)]
            if len(seconds) == 0:
                seconds = self._columns.clock.seconds(self._block(k).t)
            if len(seconds) == 0:
                raise DataError(f"{self._columns.name}: events from {first} on have no valid stamps")
            self._starts[k] = (float(np.median(seconds)), float(seconds.min()))
        return self._starts[k]

    def _block(self, k: int) -> RawEvents:
        if k in self._kept:
            self._kept.move_to_end(k)
            return self._kept[k]
        start, end = k * BLOCK, min((k + 1) * BLOCK, len(self._columns))
        raw = self._columns.read(start, end)
        if len(raw) != end - start:
            raise DataError(
                f"{self._columns.name}: became shorter while it was read; copy or download it again"
            )
        is_edge = k in (0, self._number - 1)
        block = None if is_edge else self._all_good(raw)
        number_bad = 0
        if block is None:
            good, bad = self._checked(k)
            number_bad = int((~good).sum())
            block = self._converted(RawEvents(raw.x[good], raw.y[good], raw.t[good], raw.p[good]))
            if number_bad and not self.bad.number:
                self.bad.first = bad.first
        if k not in self._bad_of:
            self._bad_of[k] = number_bad
            self.bad.number += number_bad
            self.num_read += len(raw)
            self._refuse_many(max(self.num_read, WINDOW * BLOCK))
        self._kept[k] = block
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return block

    def _all_good(self, raw: RawEvents) -> RawEvents | None:
        """Return a block with the types of `Events` if all is in order, else None."""
        width, height = self._size
        if not (_are_pixels(raw.x, width) and _are_pixels(raw.y, height)):
            return None
        negative = self._meaning.negative
        if raw.p.dtype.kind in "ub" and negative == 0:
            is_sign = bool(raw.p.max() <= 1)
        else:
            is_sign = bool(((raw.p == 1) | (raw.p == (1 if negative is None else negative))).all())
        if not is_sign or not np.isfinite(raw.t[-1]):
            return None
        if not (raw.t[1:] >= raw.t[:-1]).all():
            seconds = self._columns.clock.seconds(raw.t)
            if not (np.maximum.accumulate(seconds) - seconds).max() <= DISORDER:  # also where one is NaN
                return None
        return self._converted(raw)

    def _converted(self, raw: RawEvents) -> RawEvents:
        p = (raw.p == 1).view(np.int8) * np.int8(2) - np.int8(1)
        return RawEvents(raw.x.astype(np.int16, copy=False), raw.y.astype(np.int16, copy=False), raw.t, p)

    def _checked(self, k: int) -> tuple[np.ndarray, BadRows]:  # [N] bool
        """Return which events of a block are good, judged with the events around it, and the bad ones."""
        start, end = k * BLOCK, min((k + 1) * BLOCK, len(self._columns))
        block = self._rows.block(start - NEIGHBOURS, end)
        following = self._rows.block(end, end + NEIGHBOURS) if end < len(self._columns) else None
        checker = EventChecker(self._rows, self._size, self._meaning)
        if k > 0:
            checker.begin_after(self._start(0)[0])
        _, good = checker.check(block, following)
        return good[start - block.numbers[0] :], checker.bad

    def _refuse_many(self, among: int) -> None:
        if self.bad.number > MOST_BAD * among:
            raise DataError(
                f"{self._columns.name}: {self.bad.number} of the {self.num_read} events read so far are bad, "
                f"first {self.bad.first}"
            )


def _are_pixels(values: np.ndarray, end: int) -> bool:  # [N]
    """Return whether all numbers are whole, at least 0 and less than `end`."""
    if values.dtype.kind == "f" and not (values == np.rint(values)).all():
        return False
    return bool(values.max() < end and (values.dtype.kind == "u" or values.min() >= 0))
