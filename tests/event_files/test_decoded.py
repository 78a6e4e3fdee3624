"""AEDAT4, archives of arrays, and what holds for all formats that are decoded once."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from event_files.reading import everything
from event_files.written_aedat4 import write_aedat4
from event_files.written_prophesee import SIZE, Event, some_events, write_raw

from edslam_ti.errors import DataError, MissingExtraError
from edslam_ti.event_files import EventStream, open_events
from edslam_ti.event_files.aedat4 import aedat4_images, aedat4_imu, aedat4_streams

START = 1_700_000_000_000_000  # us


def assert_holds(stream: EventStream, events: list[Event]) -> None:
    """Compare stamps from the first one on."""
    zero = float(np.floor(stream.time_range[0]))
    found = everything(stream.shifted(zero))
    expected = np.array(events)
    assert len(stream) == len(found) == len(events)
    assert (found.x == expected[:, 0]).all()
    assert (found.y == expected[:, 1]).all()
    assert (found.t == (expected[:, 2] - round(1e6 * zero)) / 1e6).all()
    assert (found.polarity == np.where(expected[:, 3] > 0, 1, -1)).all()


# --- AEDAT4 ---


def test_aedat4(tmp_path: Path) -> None:
    events = some_events(1000, start=START)
    path = write_aedat4(tmp_path / "a.aedat4", [(0, events[:400]), (1, events[:7]), (0, events[400:])], SIZE)
    assert aedat4_streams(path) == {"0": "events", "1": "events"}
    stream = open_events(path)
    assert stream.size == SIZE
    assert_holds(stream, events)
    assert "0 is read" in stream.notes[0]
    assert len(open_events(path, group="1")) == 7
    assert len(open_events(path, group="0")) == 1000


@pytest.mark.parametrize("damage", ["cut", "garbage", "no events"])
def test_a_bad_aedat4_file_gets_one_line(tmp_path: Path, damage: str) -> None:
    path = write_aedat4(tmp_path / "a.aedat4", [(0, some_events(1000))], SIZE)
    content = path.read_bytes()
    if damage == "no events":
        write_aedat4(path, [(0, [])], SIZE)
    else:
        path.write_bytes(content[:-500] if damage == "cut" else content[:14] + b"\x99" * 5000)
    words = "expected events, got none" if damage == "no events" else "not readable as AEDAT4"
    with pytest.raises(DataError, match=words) as caught:
        open_events(path)
    assert "\n" not in str(caught.value)


def test_real_aedat4(shared_data: Path) -> None:
    path = shared_data / "aedat4" / "davis346_test_data.aedat4"
    stream = open_events(path)
    assert (len(stream), stream.size, stream.num_dropped) == (78_830, (346, 260), 0)
    assert stream.time_range == (1589163147.368868, 1589163149.728813)
    times, images = zip(*aedat4_images(path))
    assert (len(images), images[0].shape, images[0].dtype) == (59, (260, 346), np.uint8)
    assert (np.diff(times) > 0).all()
    imu_times, rows = zip(*aedat4_imu(path))
    assert (np.diff(imu_times) > 0).all()
    gravity = np.linalg.norm(np.median(np.stack(rows)[:, 3:], 0))
    assert gravity == pytest.approx(9.8, abs=0.6)  # m/s^2


def test_real_aedat4_of_another_camera(shared_data: Path) -> None:
    path = shared_data / "formats" / "aedat4_emlb_demo" / "demo-01.aedat4"
    stream = open_events(path)
    assert (len(stream), stream.size, stream.num_dropped) == (319_512, (346, 260), 0)
    assert len(list(aedat4_images(path))) == 13


# --- archives of arrays ---


@pytest.mark.parametrize(
    "how", ["columns", "long names", "signs", "matrix", "txyp", "table", "fortran", "seconds"]
)
@pytest.mark.parametrize("is_compressed", [False, True])
def test_npz(tmp_path: Path, how: str, is_compressed: bool) -> None:
    events = some_events(2000)
    x, y, t, p = np.array(events).T
    matrix = np.stack([x, y, t / 1e6, 2 * p - 1], 1)
    arrays: dict[str, np.ndarray] = {
        "columns": {"x": x.astype("u2"), "y": y.astype("u2"), "t": t, "p": p.astype("u1"), "K": np.eye(3)},
        "long names": {"x": x, "y": y, "timestamp": t, "polarity": p.astype(bool)},
        "signs": {"xs": x, "ys": y, "ts": t.astype(float), "ps": 2 * p - 1},
        "matrix": {"events": matrix},
        "txyp": {"events": matrix[:, [2, 0, 1, 3]]},
        "fortran": {"events": np.asfortranarray(matrix)},
        "seconds": {"x": x, "y": y, "t": t / 1e6, "p": p},
        "table": {"e": np.array(events, [("x", "u2"), ("y", "u2"), ("t", "i8"), ("p", "i1")])},
    }[how]
    save: Any = np.savez_compressed if is_compressed else np.savez
    save(tmp_path / "e.npz", **arrays)
    stream = open_events(tmp_path / "e.npz", SIZE)
    assert_holds(stream, events)


@pytest.mark.parametrize("damage", ["cut", "lengths", "names", "empty"])
def test_a_bad_npz_file_gets_one_line(tmp_path: Path, damage: str) -> None:
    x, y, t, p = np.array(some_events(2000)).T
    arrays: dict[str, Any] = {"x": x, "y": y, "t": t, "p": p}
    if damage == "lengths":
        arrays["p"] = p[:100]
    elif damage == "names":
        arrays["stamp"] = arrays.pop("t")
    elif damage == "empty":
        arrays = {name: values[:0] for name, values in arrays.items()}
    np.savez(tmp_path / "e.npz", **arrays)
    path = tmp_path / "e.npz"
    if damage == "cut":
        content = path.read_bytes()
        path.write_bytes(content[:9000] + b"\x00" * 3000 + content[12_000:])
    with pytest.raises(DataError) as caught:
        open_events(path, SIZE)
    words = {
        "cut": "not readable as a NumPy .npz archive",
        "lengths": "expected arrays of one length, got x 2000",
        "names": "expected arrays x, y, t, p, or one of events",
        "empty": "expected events, got none",
    }
    assert words[damage] in str(caught.value)
    assert "\n" not in str(caught.value)


def test_real_npz(shared_data: Path) -> None:
    path = shared_data / "real_events" / "ecd_poster_npz" / "poster_6dof.npz"
    truth = np.load(path)["events"]
    stream = open_events(path, (240, 180))
    assert len(stream) == 30_000
    assert "columns look like t x y p" not in "".join(stream.notes)  # they state no order
    found = everything(stream)
    assert (np.sort(found.t) == np.sort(truth[:, 0].astype(float))).all()
    assert found.x.sum() == truth[:, 1].sum()


# --- all of them ---

KILLED = """
import os, sys
from pathlib import Path
from typing import Any
from edslam_ti.event_files import open_events, raw, decoded
raw.WORDS_AT_ONCE = decoded.BLOCK = 500
def progress(share):
    if share > 0.5:
        os.kill(os.getpid(), 9)
open_events(Path(sys.argv[1]), (1280, 720), progress=progress)
"""


def test_a_killed_conversion_is_made_again(tmp_path: Path, cache: Path) -> None:
    events = some_events()
    path = write_raw(tmp_path / "a.raw", events, "2.0")
    result = subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False, capture_output=True)
    assert result.returncode == -9, result.stderr
    assert [folder.name.endswith(".partial") for folder in cache.iterdir()] == [True]
    assert_holds(open_events(path, SIZE), events)
    [copy] = cache.iterdir()
    before = copy.stat().st_mtime_ns
    assert_holds(open_events(path, SIZE), events)
    assert [folder.stat().st_mtime_ns for folder in cache.iterdir()] == [before]


def test_two_cameras_of_one_file_have_copies_of_their_own(tmp_path: Path, cache: Path) -> None:
    events = some_events(1000)
    path = write_aedat4(tmp_path / "a.aedat4", [(0, events[:400]), (1, events[:7])], SIZE)
    assert [len(open_events(path, group=group)) for group in ("0", "1", "0")] == [400, 7, 400]
    assert len(list(cache.iterdir())) == 2


@pytest.mark.parametrize("package", ["aedat", "h5py"])
def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    start = {"aedat": b"#!AER-DAT4.0\r\n", "h5py": b"\x89HDF\r\n\x1a\n"}[package]
    (tmp_path / "a.events").write_bytes(start + bytes(100))
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=r"pip install 'edslam-ti\[formats\]'"):
        open_events(tmp_path / "a.events")


def test_text_and_arrays_are_opened_too(tmp_path: Path) -> None:
    x, y, t, p = np.array(some_events(500)).T
    np.savetxt(tmp_path / "events.txt", np.stack([t / 1e6, x, y, p], 1), fmt="%.6f %d %d %d")
    np.save(tmp_path / "events.npy", np.stack([x, y, t / 1e6, p], 1))
    for name in ("events.txt", "events.npy"):
        assert_holds(open_events(tmp_path / name, SIZE), some_events(500))
        with pytest.raises(DataError, match="pass width and height"):
            open_events(tmp_path / name)


def test_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="event file not found"):
        open_events(tmp_path / "no.h5")
    with pytest.raises(DataError, match=r"expected a file with events, or a folder with x\.npy"):
        open_events(tmp_path)
    (tmp_path / "link.h5").symlink_to(tmp_path / "no.h5")
    assert os.path.lexists(tmp_path / "link.h5")
    with pytest.raises(FileNotFoundError, match="event file not found"):
        open_events(tmp_path / "link.h5")
