"""Events of one file of any size, read slice by slice."""

import copy
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from edslam_ti.cache import cache_folder
from edslam_ti.errors import DataError
from edslam_ti.event_files.checks import EventChecker, bad_rows_note, recognised_columns, sorted_by_time
from edslam_ti.event_files.copies import (
    BYTES_PER_EVENT,
    CopySummary,
    EventCopy,
    EventsInMemory,
    MappedEvents,
    num_bytes,
)
from edslam_ti.event_files.rows import BLOCK, EventSource, NpyRows
from edslam_ti.event_files.stream import Progress
from edslam_ti.event_files.text import TextRows
from edslam_ti.events import Events

IN_MEMORY = 2_000_000  # rows; smaller arrays are checked each time, which takes a quarter of a second
SLOW = 50_000_000  # bytes; longer files show a bar while they are checked

logger = logging.getLogger(__name__)


class EventFile:
    """Sorted events of a file that is checked once and then read from a compact copy.

    Rows of an array are pixel column, pixel row, seconds, polarity in {-1, +1} or {0, 1}; in a text, seconds
    come first. Bad rows are left out; `num_dropped` and `notes` state how many and why. Stamps may be out of
    order by up to `DISORDER`; slices are sorted and exact.

    A slice of the copy is memory-mapped: 1e8 events in one slice take no memory of their own unless stamps
    are shifted, which takes 8 bytes per event. `shift` seconds are subtracted from every stamp.
    """

    def __init__(
        self,
        path: Path,
        width: int,
        height: int,
        is_text: bool = False,
        progress: Progress | None = None,
    ) -> None:
        """Open an `.npy` array or a text file.

        `progress` follows the first reading of a large file; without it there is a bar on the terminal.
        Raises `DataError` for files without events, with too many bad rows, or with times in another unit.
        """
        size = (width, height)
        self._open(TextRows(path, size) if is_text else NpyRows(path), size, progress)
        self.size: tuple[int, int] | None = None  # neither arrays nor texts state it

    @classmethod
    def of(
        cls,
        source: EventSource,
        size: tuple[int, int],  # by which events are checked
        stated: tuple[int, int] | None,  # size that the file states
        notes: list[str],  # sentences for the user about the opening, that the copy does not hold
        progress: Progress | None = None,
    ) -> "EventFile":
        """Return the events of any source."""
        result = cls.__new__(cls)
        result._open(source, size, progress)
        result.size, result.notes = stated, (*notes, *result.notes)
        return result

    def _open(self, source: EventSource, size: tuple[int, int], progress: Progress | None) -> None:
        self.path = source.path
        self.shift = 0.0
        self._events, summary = _checked(source, size, progress)
        self.num_dropped = summary.num_dropped
        self.notes = summary.notes
        self._num_events = summary.num_events
        self._origin = summary.origin  # s, zero of the stored stamps
        self._first, self._last = self._events.time_range  # s, as stored

    def __len__(self) -> int:
        return self._num_events

    @property
    def time_range(self) -> tuple[float, float]:
        """Times of the first and the last event in seconds, shifted."""
        shift = self.shift - self._origin
        return self._first - shift, self._last - shift

    def shifted(self, shift: float) -> "EventFile":
        """Return the same events on a clock whose zero is at stamp `shift`."""
        result = copy.copy(self)
        result.shift = shift
        return result

    def between(self, start: float, end: float) -> Events:
        """Return the events with start <= t < end, sorted by time (stable)."""
        if not end > start:
            return Events.empty()
        shift = self.shift - self._origin
        if not self._origin:
            events = self._events.between(start + shift, end + shift)
            return replace(events, t=events.t - shift) if shift else events
        # Adding the origin rounds stamps: take a little more, and compare the rounded ones.
        slack = 1e-6
        events = self._events.between(start + shift - slack, end + shift + slack)
        events = replace(events, t=events.t - shift) if shift else events
        return events.between(start, end)


class CheckedRows:
    """Good events of an array without a copy: every slice is read from the array and sorted again."""

    def __init__(self, rows: NpyRows, checker: EventChecker, progress: Progress) -> None:
        self._rows = rows
        self._checker = checker
        self._dropped: dict[int, np.ndarray] = {}  # mask of good rows (bool) by block
        first, last, self.num_events = [], [], 0
        for k, (events, good) in enumerate(checker.checked()):
            progress(checker.share)
            if not good.all():
                self._dropped[k] = np.packbits(good)
            self.num_events += len(events)
            first.append(float(events.t.min()) if len(events) else np.inf)
            last.append(float(events.t.max()) if len(events) else -np.inf)
        # Disorder makes blocks overlap in time: keep the earliest stamp from each block on, and the latest up
        # to it.
        self._first = np.minimum.accumulate(first[::-1])[::-1]
        self._last = np.maximum.accumulate(last)

    @property
    def time_range(self) -> tuple[float, float]:
        return float(self._first[0]), float(self._last[-1])

    def between(self, start: float, end: float) -> Events:
        """Return the events with start <= t < end, sorted by time (stable)."""
        blocks = range(int(np.searchsorted(self._last, start)), int(np.searchsorted(self._first, end)))
        parts = []
        for k in blocks:
            rows = self._rows.rows(k * BLOCK, (k + 1) * BLOCK)
            if k in self._dropped:
                rows = rows[np.unpackbits(self._dropped[k], count=len(rows)).astype(bool)]
            events = self._checker.converted(rows)
            parts.append(events[(events.t >= start) & (events.t < end)])
        return sorted_by_time(Events.concatenate(parts))


def _checked(
    source: EventSource, size: tuple[int, int], progress: Progress | None
) -> tuple[EventsInMemory | MappedEvents | CheckedRows, CopySummary]:
    """Return a file's good events: from its copy, which is made if missing, or without a copy."""
    is_small = isinstance(source, NpyRows) and len(source) <= IN_MEMORY
    stored = EventCopy(cache_folder() / "events", source.path, size, source.columns, source.part)
    if not is_small:
        summary = stored.read()
        if summary is not None:
            return MappedEvents(stored.folder, size), summary
    columns = recognised_columns(source, size)
    checker = EventChecker(source, size, columns)

    def summarised(num_events: int) -> CopySummary:
        notes = list(source.notes)
        if columns.order != source.columns:
            notes.append(f"columns look like {' '.join(columns.order)} and are read in that order")
        notes += bad_rows_note(checker.bad, checker.num_rows, source.counted)
        dropped = checker.bad.number + (len(source.notes) if isinstance(source, TextRows) else 0)
        if num_events == 0:
            raise DataError(f"{source.name}: expected events, got none that is good")
        return CopySummary(num_events, checker.num_rows, dropped, tuple(notes), source.origin)

    def shown(update: Progress) -> Iterator[Events]:
        for part in checker.events():
            update(checker.share)
            yield part

    with _bar(source.path, progress) as update:
        if not is_small:
            most = source.most_events()
            try:
                if stored.has_room(most):
                    summary = stored.write(shown(update), summarised)
                    return MappedEvents(stored.folder, size), summary
                reason = f"expected room for {most * BYTES_PER_EVENT / 1e9:.1f} GB"
            except OSError as error:
                reason = str(error.strerror or error)
            logger.warning(
                "%s: no copy of its events in %s (%s); they are checked again each time",
                *(source.path, stored.folder.parent, reason),
            )
            checker = EventChecker(source, size, columns)
            if isinstance(source, NpyRows):
                rows = CheckedRows(source, checker, update)
                return rows, summarised(rows.num_events)
        events = Events.concatenate(list(shown(update)))
    return EventsInMemory(events), summarised(len(events))


@contextmanager
def _bar(path: Path, progress: Progress | None) -> Iterator[Progress]:
    """Show a bar for a large file, unless the caller receives the progress."""
    if progress is not None:
        yield progress
    elif num_bytes(path) < SLOW:
        yield lambda share: None
    else:
        from rich.console import Console
        from rich.markup import escape
        from rich.progress import Progress as Bar

        with Bar(transient=True, console=Console(stderr=True)) as bar:
            task = bar.add_task(f"checking {escape(path.name)} (first use)", total=1.0)
            yield lambda share: bar.update(task, completed=share)
