"""Events in HDF5 files, read in place.

    DSEC, VECtor          events/{x,y,t,p}, ms_to_idx, t_offset (us, added to t)
    TUM-VIE, DEVO         the same without t_offset
    M3ED                  prophesee/{left,right}/{x,y,t,p}, ms_map_idx, calib/resolution
    MVSEC                 davis/{left,right}/events [N, 4]: x, y, t [s], p; image_raw
    Prophesee             CD/events with fields x, y, p, t; attribute geometry "1280x720"
    v2e                   events [N, 4]: t [us], x, y, p

Any group with columns x, y, t, p, any table with these fields, and any array [N, 4] whose name ends with
"events" is found, whatever its path. Compressions other than gzip need the package hdf5plugin.
"""

import contextlib
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from edslam_ti.errors import DataError, MissingExtraError, plain
from edslam_ti.event_files import ecf
from edslam_ti.event_files.checks import LARGEST_SIZE, detected_order
from edslam_ti.event_files.choice import chosen
from edslam_ti.event_files.ecf import EcfDataset
from edslam_ti.event_files.rows import PROBE_LENGTH, PROBES, named_columns
from edslam_ti.event_files.stream import Clock, RawEvents
from edslam_ti.event_files.units import clock_of

INDEX_NAMES = ("ms_to_idx", "ms_map_idx")  # k-th entry: first event at or after k milliseconds
CACHE = 16_000_000  # bytes of decompressed chunks that are kept for each dataset
INDEX_SLACK = 1000  # us; an entry further off means that the index belongs to other events
INSTALL = "pip install 'edslam-ti[formats]'"


class Hdf5Columns:
    """Events of one camera in an HDF5 file."""

    def __init__(self, path: Path, size: tuple[int, int] | None, group: str | None) -> None:
        """`size` is the image's, if known; `group` names a camera, such as "left" or "prophesee/right"."""
        self.path = path
        file = _opened(path)
        tables = _tables(file)
        if not tables:
            raise DataError(
                f"{path}: expected events x, y, t, p (a group of four columns, a table with these fields, or "
                f"'events' [N, 4]), got {plain(', '.join(file)) or 'an empty file'}"
            )
        place, self.notes = chosen(f"{path}", "groups with events", tables, group)
        self.name = f"{path} ({place})"
        self._table = tables[place]
        if isinstance(self._table, _Compound) and _needs_ecf(self._table.datasets[0]):
            self._table.datasets = [EcfDataset(self._table.datasets[0])]
        else:
            for dataset in self._table.datasets:
                _check_filters(self.name, dataset)
        found = file[place]
        nearby = [found, found.parent, file] if isinstance(self._table, _Separate) else [found.parent, file]
        self.size = _stated_size(nearby, found)
        self._length = self._table.length(self.name)
        if self._length == 0:
            raise DataError(f"{self.name}: expected events, got none")
        if isinstance(self._table, _Matrix):
            known = size or self.size or LARGEST_SIZE
            self._table.order = detected_order(self._sample(), "xytp", known)
        self.clock: Clock = clock_of(self, self.name, _offset(nearby))
        self._index = self._checked_index(nearby)

    def __len__(self) -> int:
        return self._length

    def read(self, start: int, end: int) -> RawEvents:
        """Return the events start to end; raises `DataError` where the file is damaged."""
        try:
            return self._table.read(start, end)
        except (OSError, RuntimeError, ValueError) as error:
            raise self._damaged(start, end, error) from error

    def times(self, start: int, end: int) -> np.ndarray:  # [M]
        try:
            return self._table.times(start, end)
        except (OSError, RuntimeError, ValueError) as error:
            raise self._damaged(start, end, error) from error

    def near(self, seconds: float) -> int | None:
        if self._index is None:
            return None
        ms = int(1000 * (seconds - self.clock.offset / self.clock.ticks))
        return int(self._index[min(max(ms, 0), len(self._index) - 1)])

    def _damaged(self, start: int, end: int, error: Exception) -> DataError:
        return DataError(
            f"{self.name}: events {start} to {end} cannot be read ({plain(error)}); copy or download it again"
        )

    def _sample(self) -> np.ndarray:  # [S, 4] float64
        starts = np.linspace(0, max(0, len(self) - PROBE_LENGTH), PROBES).astype(np.int64)
        parts = [self.read(int(k), min(int(k) + PROBE_LENGTH, len(self))) for k in np.unique(starts)]
        return np.concatenate([np.stack([p.x, p.y, p.t, p.p], 1).astype(np.float64) for p in parts])

    def _checked_index(self, nearby: list[Any]) -> Any:
        """Return the index by milliseconds if some of its entries are right, and note it if not."""
        found = [group[name] for group in nearby for name in INDEX_NAMES if name in group]
        if not found or self.clock.ticks != 1e6 or found[0].ndim != 1 or len(found[0]) == 0:
            return None
        index, where = found[0], plain(found[0].name)
        for ms in np.unique(np.linspace(0, len(index) - 1, PROBES).astype(np.int64)):
            event = int(index[int(ms)])
            if not 0 <= event <= len(self):
                break
            before, after = self.times(max(event - 1, 0), event), self.times(event, min(event + 1, len(self)))
            if (before > 1000 * ms + INDEX_SLACK).any() or (after < 1000 * ms - INDEX_SLACK).any():
                break
        else:
            return index
        self.notes.append(f"{where} does not fit t at entry {ms} and is not used")
        return None


class _Table(Protocol):
    """Where the four columns are."""

    datasets: list[Any]

    def length(self, name: str) -> int: ...

    def read(self, start: int, end: int) -> RawEvents: ...

    def times(self, start: int, end: int) -> np.ndarray: ...


class _Separate:
    """A dataset for each column."""

    def __init__(self, columns: dict[str, Any]) -> None:
        self._columns = columns  # by "x", "y", "t", "p"
        self.datasets = list(columns.values())

    def length(self, name: str) -> int:
        lengths = {column: len(values) for column, values in self._columns.items()}
        if len(set(lengths.values())) > 1:
            there = ", ".join(f"{column} {length}" for column, length in lengths.items())
            raise DataError(f"{name}: expected columns of one length, got {there}; copy or download it again")
        return lengths["t"]

    def read(self, start: int, end: int) -> RawEvents:
        return RawEvents(**{name: values[start:end] for name, values in self._columns.items()})

    def times(self, start: int, end: int) -> np.ndarray:
        return np.asarray(self._columns["t"][start:end])


class _Compound:
    """A dataset with fields."""

    def __init__(self, dataset: Any, fields: dict[str, str]) -> None:
        self.datasets = [dataset]
        self._fields = fields  # by "x", "y", "t", "p"

    def length(self, name: str) -> int:
        return len(self.datasets[0])

    def read(self, start: int, end: int) -> RawEvents:
        rows = self.datasets[0][start:end]
        return RawEvents(**{name: np.ascontiguousarray(rows[field]) for name, field in self._fields.items()})

    def times(self, start: int, end: int) -> np.ndarray:
        return np.asarray(self.datasets[0][start:end][self._fields["t"]])


class _Matrix:
    """A dataset [N, 4]."""

    order = "xytp"

    def __init__(self, dataset: Any) -> None:
        self.datasets = [dataset]

    def length(self, name: str) -> int:
        return len(self.datasets[0])

    def read(self, start: int, end: int) -> RawEvents:
        rows = self.datasets[0][start:end]
        return RawEvents(**{name: np.ascontiguousarray(rows[:, self.order.index(name)]) for name in "xytp"})

    def times(self, start: int, end: int) -> np.ndarray:
        return np.asarray(self.datasets[0][start:end, self.order.index("t")])


def _h5py() -> Any:
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"HDF5 files need {INSTALL}") from error
    with contextlib.suppress(ModuleNotFoundError):  # gzip and lzf can be read without it
        import hdf5plugin  # noqa: F401 (it registers compressions)
    return h5py


def _opened(path: Path) -> Any:
    try:
        return _h5py().File(path, "r", rdcc_nbytes=CACHE)
    except OSError as error:
        raise DataError(
            f"{path}: not readable as HDF5 ({plain(error)}); copy or download it again"
        ) from error


def _tables(file: Any) -> dict[str, _Table]:
    """Return what may be events, by its path in the file."""
    h5py = _h5py()
    tables: dict[str, _Table] = {}

    def look(name: str, found: Any) -> None:
        if isinstance(found, h5py.Dataset):
            names = named_columns(found.dtype.names or ())
            if names and found.ndim == 1:
                tables[name] = _Compound(found, names)
            elif _is_matrix(found) and name.lower().endswith("events"):
                tables[name] = _Matrix(found)
            return
        here = {key: value for key, value in found.items() if isinstance(value, h5py.Dataset)}
        columns = {
            key: value for key, value in here.items() if value.ndim == 1 and value.dtype.kind in "fiub"
        }
        names = named_columns(columns)
        if names:
            tables[name] = _Separate({letter: columns[key] for letter, key in names.items()})

    look("/", file)
    file.visititems(look)
    return tables


def _is_matrix(dataset: Any) -> bool:
    return bool(dataset.ndim == 2 and dataset.shape[1] == 4 and dataset.dtype.kind in "fiu")


def _check_filters(name: str, dataset: Any) -> None:
    """Refuse a compression that the installed libraries do not know."""
    for code, label in _missing_filters(dataset):
        what = plain(label.decode("latin-1"), 40) or "unknown"
        raise MissingExtraError(f"{name}: compressed with HDF5 filter {code} ({what}); {INSTALL}")


def _needs_ecf(dataset: Any) -> bool:
    """Return whether Prophesee's compression alone is missing for a table."""
    return [code for code, _ in _missing_filters(dataset)] == [ecf.FILTER] and dataset.dtype == ecf.EVENT


def _missing_filters(dataset: Any) -> list[tuple[int, bytes]]:
    """Return numbers and names of the compressions that the installed libraries do not know."""
    settings = dataset.id.get_create_plist()
    used = [settings.get_filter(k) for k in range(settings.get_nfilters())]
    return [(code, label) for code, _, _, label in used if not _h5py().h5z.filter_avail(code)]


def _offset(nearby: list[Any]) -> int:
    """Return the ticks that are to be added to every stamp."""
    for group in nearby:
        if "t_offset" in group and group["t_offset"].size == 1:
            return int(np.asarray(group["t_offset"][()]).ravel()[0])
    return 0


def _stated_size(nearby: list[Any], found: Any) -> tuple[int, int] | None:
    """Return width and height from attributes, a calibration or images beside the events."""
    for group in [found, *nearby]:
        geometry = group.attrs.get("geometry", "")
        text = geometry.decode("latin-1") if isinstance(geometry, bytes) else str(geometry)
        words = text.lower().split("x")
        if len(words) == 2 and all(word.strip().isdecimal() for word in words):
            return int(words[0]), int(words[1])
        if "width" in group.attrs and "height" in group.attrs:
            return int(group.attrs["width"]), int(group.attrs["height"])
    for group in nearby:
        if "calib/resolution" in group and group["calib/resolution"].size == 2:
            width, height = np.asarray(group["calib/resolution"][()]).ravel()
            return int(width), int(height)
        if "image_raw" in group and group["image_raw"].ndim >= 3:
            return int(group["image_raw"].shape[2]), int(group["image_raw"].shape[1])
    return None


def is_hdf5(path: Path) -> bool:
    """Return whether a file is HDF5 by its first bytes."""
    with path.open("rb") as file:
        return file.read(8) == b"\x89HDF\r\n\x1a\n"
