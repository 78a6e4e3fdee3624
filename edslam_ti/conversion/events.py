"""Writes the events of a sequence slice by slice."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np

from edslam_ti.datasets.base import EventDepthSequence
from edslam_ti.events import Events
from edslam_ti.output import write_npy_header

AT_ONCE = 1_000_000  # events that are read at once, about
FIRST_SLICE, LONGEST_SLICE = 0.01, 10.0  # s
COLUMNS = {"x": "<u2", "y": "<u2", "t": "<f8", "p": "|i1"}  # file, type


class EventStream(Protocol):
    """What has events: a sequence, or an event file."""

    @property
    def time_range(self) -> tuple[float, float]:
        """Times of the first and the last event in seconds."""

    def events(self, start: float, end: float) -> Events:
        """Return the events with start <= t < end, sorted."""


def slices(stream: EventStream | EventDepthSequence) -> Iterator[tuple[Events, float]]:
    """Yield all events in consecutive slices of about `AT_ONCE`, and the share of the time that is done."""
    first, last = stream.time_range
    end = float(np.nextafter(last, np.inf))
    start, length = first, FIRST_SLICE
    while start < end:
        until = min(start + length, end)
        events = stream.events(start, until)
        yield events, (until - first) / (end - first)
        length = float(np.clip(length * AT_ONCE / max(len(events), 1), length / 8, 2 * length))
        length = min(length, LONGEST_SLICE)
        start = until


class ColumnWriter:
    """Appends events to x.npy, y.npy (uint16), t.npy (float64 s) and p.npy (int8, -1 or +1) in a folder."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.count = 0
        self._stack = contextlib.ExitStack()
        self._files: dict[str, BinaryIO] = {}
        for name, dtype in COLUMNS.items():
            self._files[name] = self._stack.enter_context((folder / f"{name}.npy").open("wb"))
            write_npy_header(self._files[name], np.dtype(dtype), 0, None)

    def append(self, events: Events) -> None:
        """Write a slice behind the last one."""
        for name, values in zip(COLUMNS, (events.x, events.y, events.t, events.polarity)):
            self._files[name].write(np.ascontiguousarray(values, np.dtype(COLUMNS[name])).data)
        self.count += len(events)

    def __enter__(self) -> "ColumnWriter":
        return self

    def __exit__(self, *error: object) -> None:
        with self._stack:
            for name, dtype in COLUMNS.items():
                write_npy_header(self._files[name], np.dtype(dtype), self.count, None)


class RowWriter:
    """Appends events to one array [N, 4] of float64: x, y, t (s), polarity -1 or +1."""

    def __init__(self, path: Path) -> None:
        self.count = 0
        self._file = path.open("wb")
        write_npy_header(self._file, np.dtype(np.float64), 0, 4)

    def append(self, events: Events) -> None:
        """Write a slice behind the last one."""
        rows = np.stack([events.x, events.y, events.t, events.polarity], -1, dtype=np.float64)
        self._file.write(np.ascontiguousarray(rows).data)
        self.count += len(events)

    def __enter__(self) -> "RowWriter":
        return self

    def __exit__(self, *error: object) -> None:
        with self._file:
            write_npy_header(self._file, np.dtype(np.float64), self.count, 4)
