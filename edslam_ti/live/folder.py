"""A directory that another process writes into, as a source.

    camera.json             first: what docs/data.md says of it, and time_unit, depth_unit
    events/NAME.npz         arrays x, y, t, p; or NAME.npy, [N, 4] x, y, t, p; taken in the order of names
    depth/STAMP.png         16 bits in depth_unit; STAMP in time_unit, digits, and decimals where it has any
    images/STAMP.png        grey, optional
    end                     an empty file: no data follow

Every file is written under another name, one that begins with a dot or ends in .tmp, and then renamed, so
that it is never seen half written. Files of a kind are taken in the order of their names, numbers by value.
"""

import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from zipfile import BadZipFile

import cv2
import numpy as np

from edslam_ti.datasets.camera_file import read_json
from edslam_ti.datasets.files import decode
from edslam_ti.errors import DataError, plain
from edslam_ti.live.items import CameraItem, DepthItem, EndItem, EventsItem, ImageItem, Item, NoteItem
from edslam_ti.live.messages import MOST_EVENTS, camera_item

POLL = 0.01  # seconds between two looks
SHARE = 0.1  # of the time is spent looking: large directories are looked at less often
STAMP = re.compile(r"[0-9]{1,19}(\.[0-9]{1,9})?")
KINDS = ("events", "depth", "images")


class FolderSource:
    """Hands over the files that appear in a directory (`Source`)."""

    is_live = True

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise DataError(f"{plain(folder, 400)}: expected a directory that another process writes into")
        self._folder = folder
        self.description = f"files in {plain(folder)}"
        self._is_closed = threading.Event()
        self._taken: dict[str, set[str]] = {kind: set() for kind in KINDS}

    def items(self) -> Iterator[Item]:
        """Yield what appears, until there is a file `end` or the source is closed."""
        camera = self._camera()
        if camera is None:
            return
        yield camera
        while not self._is_closed.is_set():
            began = time.monotonic()
            is_ended = (self._folder / "end").exists()  # before looking: what was written earlier is there
            new = [(kind, path) for kind in KINDS for path in self._new_files(kind)]
            for kind, path in new:
                yield self._item(kind, path, camera)
            if is_ended:
                yield EndItem()
                return
            took = time.monotonic() - began
            if not new and self._is_closed.wait(max(POLL, took / SHARE)):
                return

    def close(self) -> None:
        self._is_closed.set()

    def _camera(self) -> CameraItem | None:
        path = self._folder / "camera.json"
        while not path.exists():
            if self._is_closed.wait(POLL) or (self._folder / "end").exists():
                return None
        return camera_item(read_json(path), str(path))

    def _new_files(self, kind: str) -> list[Path]:
        """Return the files of a kind that have not been taken yet, in order, and take them."""
        folder, taken = self._folder / kind, self._taken[kind]
        suffixes = (".npz", ".npy") if kind == "events" else (".png",)
        try:
            paths = [p for p in folder.iterdir() if p.name not in taken]
        except FileNotFoundError:
            return []
        whole = [p for p in paths if p.suffix.lower() in suffixes and not p.name.startswith(".")]
        taken.update(p.name for p in whole)
        return sorted(whole, key=_in_order)

    def _item(self, kind: str, path: Path, camera: CameraItem) -> Item:
        """Return what a file holds, or a note where it cannot be used."""
        try:
            if kind == "events":
                return _events(path)
            stamp = _stamp(path, camera)
            if kind == "depth":
                depth = decode(path, cv2.IMREAD_UNCHANGED, camera.file.camera, "depth")
                if depth.dtype != np.uint16 or depth.ndim != 2:
                    raise DataError(f"{path}: expected a depth PNG of 16 bits, got {depth.dtype}")
                return DepthItem(stamp, depth)
            return ImageItem(stamp, decode(path, cv2.IMREAD_GRAYSCALE, camera.file.camera))
        except (DataError, OSError) as error:
            return NoteItem(f"left out: {plain(error)}")


def _in_order(path: Path) -> tuple[float, str]:
    return (float(path.stem) if STAMP.fullmatch(path.stem) else 0.0), path.name


def _stamp(path: Path, camera: CameraItem) -> float:
    if not STAMP.fullmatch(path.stem):
        raise DataError(f"{path}: expected a time stamp in {camera.time_unit} as the name, got '{path.stem}'")
    return float(path.stem) if "." in path.stem else int(path.stem)


def _events(path: Path) -> EventsItem:
    """Return the events of a file; raises DataError where it holds none that can be used."""
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            if loaded.ndim != 2 or loaded.shape[1] != 4:
                raise DataError(f"{path}: expected events [N, 4] x, y, t, p, got shape {loaded.shape}")
            columns = {name: loaded[:, k] for k, name in enumerate("xytp")}
        else:
            with loaded:
                missing = [name for name in "xytp" if name not in loaded.files]
                if missing:
                    raise DataError(f"{path}: expected arrays x, y, t, p; {', '.join(missing)} missing")
                columns = {name: loaded[name] for name in "xytp"}
    except (ValueError, EOFError, BadZipFile, KeyError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path}: not readable as NumPy arrays ({plain(error)})") from error
    if len(columns["t"]) > MOST_EVENTS:
        raise DataError(f"{path}: expected at most {MOST_EVENTS} events a file, got {len(columns['t'])}")
    return EventsItem(columns["x"], columns["y"], columns["t"], columns["p"])
