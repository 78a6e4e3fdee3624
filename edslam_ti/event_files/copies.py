"""Compact copies of checked events in the user's cache: four raw arrays in a folder, 13 bytes per event.

    x.bin, y.bin     int16     pixel
    t.bin            float64   seconds as the file states them, less an origin, ascending
    polarity.bin     int8      -1 or +1
    events.json      number of events, rows that were left out, origin of the stamps

Seconds stay float64. Whole microseconds would take as much space, and change the stamps of simulated
recordings, which are in nanoseconds or float32.

A copy is identified by the path, size and modification time of its source, and by the camera. It is written
under a temporary name that contains the process's number. So the remains of a killed process are never taken
for a finished copy, and the next process removes them.
"""

import contextlib
import hashlib
import json
import os
import platform
import re
import shutil
import uuid
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.events import Events

VERSION = 1  # increase it when the checks change, so that copies are made again
DTYPES = {n: np.dtype(d) for n, d in (("x", "<i2"), ("y", "<i2"), ("t", "<f8"), ("polarity", "i1"))}
BYTES_PER_EVENT = sum(dtype.itemsize for dtype in DTYPES.values())
DESCRIPTION = "events.json"
CHECKED_AT_ONCE = 100_000  # events; intermediate results stay in a core's cache
SPARE_ROOM = 100_000_000  # bytes that a copy leaves free on the disk


@dataclass(frozen=True)
class CopySummary:
    """Facts about checked events."""

    num_events: int
    num_rows: int  # of the source
    num_dropped: int
    notes: tuple[str, ...] = ()  # sentences for the user
    origin: float = 0.0  # s, to be added to the stored stamps


class EventsInMemory:
    """Sorted events that have been checked."""

    def __init__(self, events: Events) -> None:
        self._events = events

    def between(self, start: float, end: float) -> Events:
        """Return the events with start <= t < end (views)."""
        return self._events.between(start, end)

    @property
    def time_range(self) -> tuple[float, float]:
        return float(self._events.t[0]), float(self._events.t[-1])


class MappedEvents:
    """The sorted events of a copy. Slices are memory-mapped: data is read on access."""

    def __init__(self, folder: Path, size: tuple[int, int]) -> None:
        self._folder = folder
        self._size = size
        # Files stay open, so that a copy can still be read after it was removed or replaced.
        self._files = {name: (folder / f"{name}.bin").open("rb") for name in DTYPES}

    def between(self, start: float, end: float) -> Events:
        """Return the events with start <= t < end, read-only.

        Each slice has a mapping of its own, so that its pages leave the process with it.
        """
        events = self._all().between(start, end)
        for piece in events.pieces(CHECKED_AT_ONCE):
            self._check(piece)
        return events

    @property
    def time_range(self) -> tuple[float, float]:
        t = self._all().t
        return float(t[0]), float(t[-1])

    def _all(self) -> Events:
        return Events(**{name: _mapped(self._files[name], dtype) for name, dtype in DTYPES.items()})

    def _check(self, events: Events) -> None:
        """Refuse values from a damaged disk, with which kernels would write outside their images."""
        width, height = self._size
        # Negative numbers are large as unsigned ones; adding one turns -1 and 1 into 0 and 2.
        is_inside = events.x.view(np.uint16).max() < width and events.y.view(np.uint16).max() < height
        sign = (events.polarity + np.int8(1)).view(np.uint8)
        is_sign = sign.max() <= 2 and not (sign & 1).any()
        if not (is_inside and is_sign and (events.t[1:] >= events.t[:-1]).all()):
            raise DataError(f"{self._folder}: damaged; remove it, and it is made again")


def _mapped(file: BinaryIO, dtype: np.dtype) -> np.ndarray:
    return np.memmap(file, dtype, mode="r").view(np.ndarray)


class EventCopy:
    """The compact copy of one source in a folder of copies."""

    def __init__(
        self, parent: Path, source: Path, size: tuple[int, int], settings: str, part: str = ""
    ) -> None:
        """`settings` names everything else that the copy depends on; each `part` has a copy of its own."""
        self._parent = parent
        self._source = source
        path = _digest(str(source.resolve()) + (f"|{part}" if part else ""))
        state = _digest(f"{VERSION}|{_state(source)}|{size}|{settings}")
        self._prefix = f"{_plain(source.parent.name)}_{path}_"
        self.folder = parent / f"{self._prefix}{state}"

    def read(self) -> CopySummary | None:
        """Return the copy's summary; None: there is no copy, or it is damaged."""
        try:
            values = json.loads((self.folder / DESCRIPTION).read_text(encoding="utf-8"))
            summary = CopySummary(**values | {"notes": tuple(values["notes"])})
            for name, dtype in DTYPES.items():
                if (self.folder / f"{name}.bin").stat().st_size != summary.num_events * dtype.itemsize:
                    return None
        except (OSError, ValueError, TypeError, KeyError, RecursionError):
            return None
        return summary if summary.num_events > 0 else None

    def has_room(self, most_events: int) -> bool:
        """Return whether the disk has room for that many events."""
        self._parent.mkdir(parents=True, exist_ok=True)
        return shutil.disk_usage(self._parent).free > most_events * BYTES_PER_EVENT + SPARE_ROOM

    def write(self, parts: Iterable[Events], summary: Callable[[int], CopySummary]) -> CopySummary:
        """Write the copy, which gets its name when it is complete. Raises `OSError`.

        `summary` is called with the number of events after all have been written.
        """
        self._parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self._parent)
        partial = self._parent / f".{uuid.uuid4().hex[:8]}.{_host()}.{os.getpid()}.partial"
        partial.mkdir()
        try:
            number = 0
            with contextlib.ExitStack() as stack:
                files = {n: stack.enter_context((partial / f"{n}.bin").open("wb")) for n in DTYPES}
                for part in parts:
                    for name, dtype in DTYPES.items():
                        files[name].write(np.ascontiguousarray(getattr(part, name), dtype).data)
                    number += len(part)
                for file in files.values():  # after a power cut no finished copy may contain zeros
                    file.flush()
                    os.fsync(file.fileno())
            result = summary(number)
            (partial / DESCRIPTION).write_text(json.dumps(asdict(result)), encoding="utf-8")
            self._replace(partial)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        return result

    def _replace(self, partial: Path) -> None:
        """Rename a finished copy; remove damaged and outdated copies of the same source."""
        for old in self._parent.glob(f"{self._prefix}*"):
            if old != self.folder or self.read() is None:
                shutil.rmtree(old, ignore_errors=True)
        try:
            partial.rename(self.folder)
        except OSError:
            if self.read() is None:  # else another process was faster
                raise


def num_bytes(source: Path) -> int:
    """Return the size of a file, or of the files in a folder."""
    return sum(path.stat().st_size for path in _files(source))


def _files(source: Path) -> list[Path]:
    return sorted(path for path in source.iterdir() if path.is_file()) if source.is_dir() else [source]


def _state(source: Path) -> str:
    """Return size and modification time of a file, or of all files in a folder."""
    states = [path.stat() for path in _files(source)]
    return "|".join(f"{state.st_size}|{state.st_mtime_ns}" for state in states)


def remove_leftovers(parent: Path) -> None:
    """Remove partial copies of processes of this machine that no longer run."""
    for path in parent.glob(".*.partial"):
        match = re.fullmatch(r"\.[0-9a-f]{8}\.(.+)\.(\d+)\.partial", path.name)
        if match and match[1] == _host() and not _runs(int(match[2])):
            shutil.rmtree(path, ignore_errors=True)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def _host() -> str:
    return _digest(platform.node())


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:12]


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9-]", "-", name)[:40]
