"""Checks and sorts a stream of events; leaves out and counts bad rows, and refuses too many of them."""

import itertools
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.event_files.rows import BLOCK, EventSource, RowBlock
from edslam_ti.events import Events

DISORDER = 5e-3  # s: simulators sort in blocks of 1 ms or so, not globally (gray_events_data.npy)
LONGEST_RECORDING = 2e5  # s: a longer span means that the stamps are not in seconds
MOST_BAD = 0.01  # share of the rows; more bad rows mean that the file has another format
WINDOW = 8  # blocks, about a million rows, in which a larger share of bad rows is refused at once
NEIGHBOURS = 16  # events on either side with which a stamp is compared
ORDERS = ("xytp", "txyp", "xypt")  # orders of columns that programs write
LARGEST_SIZE = (32_767, 32_767)  # pixels; where the size of the image is not known
ENOUGH_TO_TELL = 100  # rows needed to detect an order that is not the expected one
# A few stamps at either end of a recording may belong to another time (left over from before, or a broken
# last row). They do if a gap of this length, in seconds and in lengths of the recording, separates them from
# the rest.
OTHER_TIME, OTHER_TIME_LENGTHS = 60.0, 10.0
AT_ONCE = 65_536  # stamps whose neighbours are compared at once


@dataclass
class BadRows:
    """Rows that were left out."""

    number: int = 0
    first: str = ""  # the first one: its number, its values, and what was expected


@dataclass(frozen=True)
class Columns:
    """Meaning of a file's columns."""

    order: str  # such as "xytp"
    negative: float | None  # the file's number for polarity -1: -1 or 0; None: no negative event

    def index(self, name: str) -> int:
        return self.order.index(name)


def recognised_columns(source: EventSource, size: tuple[int, int]) -> Columns:
    """Return the order of columns, detected from the values if the expected order does not fit.

    Raises `DataError` for times that are not in seconds.
    """
    rows = source.sample()
    order = detected_order(rows, source.columns, size)
    t = rows[:, order.index("t")]
    t = t[np.isfinite(t)]
    if len(t) and (span := float(np.subtract(*np.percentile(t, [99, 1])))) > LONGEST_RECORDING:
        _refuse_unit(source, order, span)
    return Columns(order, negative_polarity(rows[:, order.index("p")]))


def detected_order(
    rows: np.ndarray,  # [S, 4]
    expected: str,
    size: tuple[int, int],
) -> str:
    """Return the order of columns: the expected one, unless another one alone fits the values."""
    if len(rows) < ENOUGH_TO_TELL or _fits(rows, expected, size):
        return expected
    fitting = [other for other in ORDERS if _fits(rows, other, size)]
    return fitting[0] if len(fitting) == 1 else expected


def _fits(rows: np.ndarray, order: str, size: tuple[int, int]) -> bool:  # [S, 4]
    """Return whether nearly all rows are plausible in an order of columns."""
    x, y, t, p = (rows[:, order.index(name)] for name in "xytp")
    negative = negative_polarity(p)
    with np.errstate(invalid="ignore"):
        good = (x >= 0) & (x < size[0]) & (x == np.rint(x)) & (y >= 0) & (y < size[1]) & (y == np.rint(y))
        good &= np.isfinite(t) & ((p == 1) | (p == (1 if negative is None else negative)))
        t = t[good]
        if len(t) < (1 - MOST_BAD) * len(rows) or len(t) == 0 or t[-1] <= t[0]:
            return False
        tolerance = max(DISORDER, 1e-3 * (t[-1] - t[0]))  # of times in any unit
        return bool((np.diff(t) < -tolerance).mean() <= MOST_BAD) if len(t) > 1 else True


def negative_polarity(polarity: np.ndarray) -> float | None:
    """Return the number for negative events: the more frequent of -1 and 0."""
    minus, zero = int((polarity == -1).sum()), int((polarity == 0).sum())
    return None if minus + zero == 0 else -1.0 if minus >= zero else 0.0


def _refuse_unit(source: EventSource, order: str, span: float) -> NoReturn:
    looks = f"; columns look like {' '.join(order)}" if order != source.columns else ""
    raise DataError(
        f"{source.name}: expected times in seconds, got {span / 86400:.3g} days of recording{looks}; these "
        f"look like micro- or nanoseconds: divide {source.column(order.index('t'))} by 1e6 or 1e9"
    )


class EventChecker:
    """Turns a file's rows into sorted events.

    A row is bad if its pixel is outside the image or not an integer, its time not finite or out of place, or
    its polarity neither of the two. Stamps may be out of order by up to `DISORDER`. The file is refused if
    the share of bad rows, among all or among about a million, exceeds `MOST_BAD`.
    """

    def __init__(self, source: EventSource, size: tuple[int, int], columns: Columns) -> None:
        self.bad = BadRows()
        self.num_rows = 0
        self.share = 0.0  # of the file that has been checked
        self._typical = ""  # the first row that is bad for the most frequent reason of its block
        self._source = source
        self._size = size
        self._columns = columns
        self._negative = columns.negative
        self._newest = -np.inf  # s, largest good stamp so far
        self._oldest = np.nan  # s, first good stamp
        self._recent = np.empty(0)  # [<= NEIGHBOURS] s, last good stamps
        self._window: deque[tuple[int, int]] = deque(maxlen=WINDOW)  # rows and bad ones of the last blocks
        self._held: list[Events] = []  # in order of the file; later rows may still come between them
        self._merge_at = 0  # number of held events that are worth sorting

    def events(self) -> Iterator[Events]:
        """Yield all good events, sorted by time (stable)."""
        for good, _ in self.checked():
            self._held.append(good)
            if sum(len(part) for part in self._held) > self._merge_at:
                yield self._sorted_until(self._newest - DISORDER)
        yield self._sorted_until(np.inf)

    def checked(self) -> Iterator[tuple[Events, np.ndarray]]:
        """Yield for every block its good events in the order of the file, and a mask of their rows (bool)."""
        blocks = itertools.chain(self._source.blocks(), [None])
        for block, following in itertools.pairwise(blocks):
            if block is None:
                break
            self.share = block.share
            yield self.check(block, following)
        self.end()

    def begin_after(self, oldest: float) -> None:
        """Start in the middle of a recording whose first stamp is known (s)."""
        self._oldest = oldest

    def end(self) -> None:
        """Refuse a file without events, or with too many bad ones among all."""
        if self.num_rows == 0:
            expected = " ".join(self._source.columns)
            raise DataError(f"{self._source.name}: expected events '{expected}', got none")
        self._refuse_many(is_end=True)

    def converted(self, rows: np.ndarray) -> Events:  # [N, 4]
        """Return rows that have been checked before as events, in their order."""
        x, y, t, p = (np.ascontiguousarray(rows[:, self._columns.index(name)]) for name in "xytp")
        polarity = (p == 1).view(np.int8) * np.int8(2) - np.int8(1)
        return Events(x.astype(np.int16), y.astype(np.int16), t.astype(np.float64, copy=False), polarity)

    def _sorted_until(self, end: float) -> Events:
        """Return the held events before `end` sorted, and hold the rest."""
        events = sorted_by_time(Events.concatenate(self._held))
        number = int(np.searchsorted(events.t, end))
        rest = events[number:]
        self._held = [rest]
        # Wait for twice as many as remain, so that a burst is not sorted again and again.
        self._merge_at = 2 * len(rest) + BLOCK // 2
        return events[:number]

    def check(self, block: RowBlock, following: RowBlock | None) -> tuple[Events, np.ndarray]:
        """Return a block's good events, and a mask of their rows (bool); blocks come one after the other."""
        x, y, t, p = (np.ascontiguousarray(block.rows[:, self._columns.index(name)]) for name in "xytp")
        t = t.astype(np.float64, copy=False)
        with np.errstate(invalid="ignore"):  # NaN to int: caught by the comparison
            column, row = x.astype(np.int16), y.astype(np.int16)
        if self._negative is None:
            self._negative = negative_polarity(p)
        positive = p == 1
        is_place = (column == x) & (row == y)
        # Negative numbers are large as unsigned ones.
        is_place &= (column.view(np.uint16) < self._size[0]) & (row.view(np.uint16) < self._size[1])
        is_sign = positive if self._negative is None else positive | (p == self._negative)
        is_time = np.isfinite(t)
        good = is_place & is_sign & is_time
        is_late = self._out_of_place(t, good, following)
        if is_late is not None:
            good = good & ~is_late
        self.num_rows += len(t)
        self._window.append((len(t), len(t) - int(good.sum())))
        if not good.all():
            self._count_bad(block, good, [is_place, is_time, is_sign])
        kept = t[good] if not good.all() else t
        self._take_in(block, good, kept)
        events = Events(column, row, t, positive.view(np.int8) * np.int8(2) - np.int8(1))
        return (events if good.all() else events[good]), good

    def _take_in(self, block: RowBlock, good: np.ndarray, t: np.ndarray) -> None:
        """Refuse stamps [M] of good rows that are out of order or not in seconds; record the newest."""
        if len(t) == 0:
            return
        if np.isnan(self._oldest):
            self._oldest = float(t[0])
        if abs(t[-1] - self._oldest) > LONGEST_RECORDING:
            _refuse_unit(self._source, self._columns.order, abs(float(t[-1] - self._oldest)))
        backward = np.maximum(np.maximum.accumulate(t), self._newest) - t
        worst = int(backward.argmax())
        if backward[worst] > DISORDER:
            self._refuse(
                self._described(
                    block,
                    int(np.flatnonzero(good)[worst]),
                    f"stamps in order to within {1000 * DISORDER:g} ms (this one is {backward[worst]:.6g} s "
                    "before an earlier row; sort the events by time)",
                )
            )
        self._newest = max(self._newest, float(t.max()))
        self._recent = np.concatenate([self._recent, t[-NEIGHBOURS:]])[-NEIGHBOURS:]

    def _out_of_place(
        self, t: np.ndarray, good: np.ndarray, following: RowBlock | None
    ) -> np.ndarray | None:  # [N], [N] -> [N] bool
        """Return which good stamps are out of order and far from their neighbours; None: no stamp is."""
        after = np.empty(0)
        if following is not None:
            after = following.rows[:NEIGHBOURS, self._columns.index("t")].astype(np.float64)
            after = after[np.isfinite(after)]
        is_whole = bool(good.all())
        stamps = np.concatenate([t if is_whole else t[good], after])
        if len(stamps) == 0:
            return None
        newest = np.maximum(np.maximum.accumulate(stamps), self._newest)
        if (newest - stamps).max() <= DISORDER:
            return self._at_ends(t, good, is_end=following is None)
        stamps = np.concatenate([self._recent, stamps])
        is_wrong = _is_out_of_order(stamps, np.ones(len(stamps), bool))
        is_wrong &= np.abs(stamps - _running_median(stamps)) > DISORDER
        # A good stamp next to a gap and a bad stamp may be far from its median. Without the bad stamp it is
        # in order.
        is_wrong &= _is_out_of_order(stamps, ~is_wrong)
        first = len(self._recent)
        result = np.zeros(len(t), bool)
        result[good] = is_wrong[first : len(stamps) - len(after)]
        return result

    def _at_ends(self, t: np.ndarray, good: np.ndarray, is_end: bool) -> np.ndarray | None:  # [N] bool
        """Return which stamps of a sorted block belong to another time than the recording; None: no stamp."""
        index = np.flatnonzero(good)
        first, last = 0, len(index)
        if np.isnan(self._oldest):
            for k in range(1, min(NEIGHBOURS + 1, len(index))):
                gap = t[index[k]] - t[index[k - 1]]
                if gap > max(OTHER_TIME, OTHER_TIME_LENGTHS * (t[index[-1]] - t[index[k]])):
                    first = k
        begin = t[index[first]] if np.isnan(self._oldest) and first < last else self._oldest
        if is_end:
            for k in range(max(first + 1, len(index) - NEIGHBOURS), len(index)):
                gap = t[index[k]] - t[index[k - 1]]
                if gap > max(OTHER_TIME, OTHER_TIME_LENGTHS * (t[index[k - 1]] - begin)):
                    last = k
                    break
        if (first, last) == (0, len(index)):
            return None
        result = np.zeros(len(t), bool)
        result[index[:first]] = result[index[last:]] = True
        return result

    def _count_bad(self, block: RowBlock, good: np.ndarray, checks: list[np.ndarray]) -> None:
        """Record the first bad row, and refuse the block if it has too many."""
        width, height = self._size
        expected = [
            f"x in 0 to {width - 1} and y in 0 to {height - 1}",
            "a finite time in seconds",
            "polarity -1 or +1 (or 0 or 1) throughout",
            f"stamps in order to within {1000 * DISORDER:g} ms; sort the events by time",
        ]
        # Each bad row counts for the first check that it fails.
        reason = np.select([~check for check in checks], range(len(checks)), len(checks))
        bad = np.flatnonzero(~good)
        if not self.bad.number:
            self.bad.first = self._described(block, int(bad[0]), expected[int(reason[bad[0]])])
        self.bad.number += len(bad)
        frequent = int(np.bincount(reason[bad]).argmax())
        typical = int(bad[reason[bad] == frequent][0])
        self._typical = self._described(block, typical, expected[frequent])
        self._refuse_many(is_end=False)

    def _refuse_many(self, is_end: bool) -> None:
        rows, bad = (sum(column) for column in zip(*self._window))
        if is_end and self.bad.number > MOST_BAD * self.num_rows:
            rows, bad = self.num_rows, self.bad.number
        if bad > MOST_BAD * (rows if is_end else WINDOW * BLOCK):
            self._refuse(f"{self._typical}; {bad} of {rows} {self._source.counted}s are bad")

    def _described(self, block: RowBlock, k: int, expected: str) -> str:
        """Return a text with the number of row k of the block, what was expected, and its values."""
        where = f"{self._source.counted} {block.numbers[k]}"
        names = self._columns.order
        if k in block.unreadable:
            return f"{where}: expected 4 numbers '{' '.join(names)}', got '{block.unreadable[k]}'"
        values = ", ".join(f"{float(v):.10g}" for v in block.rows[k])
        width, height = self._size
        return (
            f"{where}: expected {expected}, got {', '.join(names)} = {values} "
            f"(image {width}x{height}, times in seconds)"
        )

    def _refuse(self, problem: str) -> NoReturn:
        raise DataError(f"{self._source.name}: {problem}")


def bad_rows_note(bad: BadRows, num_rows: int, counted: str) -> list[str]:
    """Return the sentence about rows that were left out, if any were."""
    if not bad.number:
        return []
    are = "are" if bad.number > 1 else "is"
    return [f"{bad.number} of {num_rows} {counted}s {are} bad and left out, first {bad.first}"]


def sorted_by_time(events: Events) -> Events:
    """Return events sorted by time (stable)."""
    if len(events) == 0 or (events.t[1:] >= events.t[:-1]).all():
        return events
    return events[np.argsort(events.t, kind="stable")]


def _is_out_of_order(stamps: np.ndarray, among: np.ndarray) -> np.ndarray:  # [N], [N] bool -> [N] bool
    """Return which stamps are earlier than one before or later than one after them, compared `among` some."""
    before = np.maximum.accumulate(np.where(among, stamps, -np.inf))
    behind = np.minimum.accumulate(np.where(among, stamps, np.inf)[::-1])[::-1]
    return (stamps < before - DISORDER) | (stamps > behind + DISORDER)


def _running_median(values: np.ndarray) -> np.ndarray:  # [N] -> [N]
    """Return the median of each value and `NEIGHBOURS` on either side.

    Values beyond the ends count as earlier and later than all, so that the median of sorted stamps is each
    stamp itself, whatever the gaps.
    """
    ends = np.full(NEIGHBOURS, np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.concatenate([-ends, values, ends]), 2 * NEIGHBOURS + 1
    )
    parts = [
        np.partition(windows[start : start + AT_ONCE], NEIGHBOURS, axis=1)[:, NEIGHBOURS]
        for start in range(0, len(values), AT_ONCE)
    ]
    return np.concatenate(parts)
