"""Event files of any format and length, read slice by slice.

| format | read |
|---|---|
| HDF5 (DSEC, VECtor, TUM-VIE, M3ED, MVSEC, Prophesee, DEVO, v2e) | in place |
| Prophesee DAT (.dat) | in place |
| a folder with x.npy, y.npy, t.npy, p.npy | in place |
| an array [N, 4] or with fields x, y, t, p (.npy) | checked at first use, then from a copy in the cache |
| text, one event per line | the same |
| Prophesee RAW: EVT 2.0, 2.1, 3.0 (.raw) | the same |
| AEDAT4 (.aedat4) | the same |
| ROS bags (.bag, .db3, .mcap) | the same |
| archives of arrays (.npz) | the same |

`open_events` recognises a format by its first bytes, else by its suffix.
"""

import zipfile
from pathlib import Path

from edslam_ti.errors import DataError, plain
from edslam_ti.event_files.aedat4 import aedat4_rows, is_aedat4
from edslam_ti.event_files.bags import bag_rows, is_bag
from edslam_ti.event_files.checked import EventFile
from edslam_ti.event_files.dat import DatColumns, is_dat
from edslam_ti.event_files.decoded import DecodedRows
from edslam_ti.event_files.hdf5 import Hdf5Columns, is_hdf5
from edslam_ti.event_files.npy_columns import NAMES, NpyColumns, has_columns
from edslam_ti.event_files.npz import npz_rows
from edslam_ti.event_files.raw import is_prophesee, raw_rows
from edslam_ti.event_files.sliced import SlicedEvents
from edslam_ti.event_files.stream import EventColumns, EventStream, Progress

__all__ = ["EventFile", "EventStream", "Progress", "open_events"]

TEXTS = (".txt", ".csv")
READABLE = "HDF5, RAW, DAT, AEDAT4, ROS bag, .npy, .npz, text, or a folder with x.npy, y.npy, t.npy, p.npy"


def open_events(
    path: Path,
    size: tuple[int, int] | None = None,
    *,
    group: str | None = None,
    progress: Progress | None = None,
) -> EventStream:
    """Return the events of a file.

    `size` is the image's width and height, by which events are checked; without it that of the file applies.
    `group` chooses the camera where a file holds several. `progress` follows a first reading that takes long;
    without it there is a bar on the terminal.

    Raises `FileNotFoundError`, `MissingExtraError` where an optional package is needed, and `DataError` for
    anything else that is wrong.
    """
    path = Path(path)
    if path.is_dir() and is_bag(path):
        return _decoded(*bag_rows(path, group), size, progress)
    if path.is_dir():
        if not has_columns(path):
            wanted = ", ".join(f"{name}.npy" for name in NAMES)
            raise DataError(f"{path}: expected a file with events, or a folder with {wanted}")
        return _in_place(NpyColumns(path), size)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: event file not found")
    if path.stat().st_size == 0:
        raise DataError(f"{path}: the file is empty; expected events as {READABLE}")
    if is_hdf5(path):
        return _in_place(Hdf5Columns(path, size, group), size)
    if is_prophesee(path):
        if is_dat(path):
            return _in_place(DatColumns(path), size)
        return _decoded(*raw_rows(path), size, progress)
    if is_aedat4(path):
        return _decoded(*aedat4_rows(path, group), size, progress)
    if zipfile.is_zipfile(path):
        return _decoded(npz_rows(path, size), None, size, progress)
    if is_bag(path):
        return _decoded(*bag_rows(path, group), size, progress)
    suffix = path.suffix.lower()
    if suffix == ".npy" or suffix in TEXTS:
        width, height = _known(path, size)
        return EventFile(path, width, height, is_text=suffix in TEXTS, progress=progress)
    raise DataError(f"{path}: expected events as {READABLE}, got a file that is none of them")


def _decoded(
    rows: DecodedRows, stated: tuple[int, int] | None, size: tuple[int, int] | None, progress: Progress | None
) -> EventStream:
    return EventFile.of(rows, _known(rows.name, size or stated), stated, rows.opening_notes, progress)


def _in_place(columns: EventColumns, size: tuple[int, int] | None) -> EventStream:
    return SlicedEvents(columns, _known(columns.name, size or columns.size))


def _known(name: Path | str, size: tuple[int, int] | None) -> tuple[int, int]:
    if size is None:
        raise DataError(f"{plain(name)}: does not state the size of its image; pass width and height")
    return size
