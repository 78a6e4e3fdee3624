"""Events of a file: the compact copy, what is left out, and in which order columns are read."""

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from written_sequences import HEIGHT, WIDTH, some_events

from edslam_ti.errors import DataError
from edslam_ti.event_files import checked, checks, copies
from edslam_ti.event_files.checked import EventFile
from edslam_ti.events import Events


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("EDSLAM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "events"


@pytest.fixture
def copied(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small files are copied, too, and read in many blocks."""
    monkeypatch.setattr(checked, "IN_MEMORY", 0)
    for module in ("rows", "checks", "checked"):
        monkeypatch.setattr(f"edslam_ti.event_files.{module}.BLOCK", 500)


def saved(folder: Path, events: np.ndarray) -> Path:
    np.save(folder / "e.npy", events)
    return folder / "e.npy"


def opened(path: Path, **arguments: Any) -> EventFile:
    return EventFile(path, WIDTH, HEIGHT, **arguments)


def assert_same(events: Events, rows: np.ndarray) -> None:
    assert (events.x == rows[:, 0]).all()
    assert (events.y == rows[:, 1]).all()
    assert (events.t == rows[:, 2]).all()
    assert (events.polarity == rows[:, 3]).all()
    assert [a.dtype for a in (events.x, events.y, events.t, events.polarity)] == ["i2", "i2", "f8", "i1"]


# --- the compact copy ---


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize("dtype", ["<f8", "<f4", ">f8"])
def test_a_copy_holds_the_same_numbers(tmp_path: Path, cache: Path, dtype: str) -> None:
    rows = some_events().astype(dtype)
    events = opened(saved(tmp_path, rows))
    assert len(events) == 3000
    assert_same(events.between(0, 1), rows)
    inside = rows[(rows[:, 2] >= 0.1) & (rows[:, 2] < 0.2)]
    assert_same(events.between(0.1, 0.2), inside)
    assert events.time_range == (rows[0, 2], rows[-1, 2])
    [folder] = cache.iterdir()
    assert sum(p.stat().st_size for p in folder.glob("*.bin")) == 13 * 3000


@pytest.mark.usefixtures("copied")
def test_the_file_is_read_once_and_again_when_it_changes(tmp_path: Path, cache: Path) -> None:
    path = saved(tmp_path, some_events())
    first = opened(path)
    [folder] = cache.iterdir()
    written = (folder / "t.bin").stat().st_mtime_ns
    opened(path)
    assert [(folder / "t.bin").stat().st_mtime_ns for folder in cache.iterdir()] == [written]
    saved(tmp_path, some_events(2000))
    assert len(opened(path)) == 2000
    assert len(list(cache.iterdir())) == 1
    assert len(first.between(0, 1)) == 3000  # open files outlive their names


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize("damage", ["shorter", "no description", "not JSON", "no column", "strange numbers"])
def test_a_damaged_copy_is_made_again(tmp_path: Path, cache: Path, damage: str) -> None:
    path = saved(tmp_path, some_events())
    opened(path)
    [folder] = cache.iterdir()
    if damage == "shorter":
        os.truncate(folder / "t.bin", 100)
    elif damage == "no column":
        (folder / "x.bin").unlink()
    elif damage == "no description":
        (folder / "events.json").unlink()
    else:
        (folder / "events.json").write_text('{"num_events": 1}' if damage == "strange numbers" else "{")
    assert_same(opened(path).between(0, 1), some_events())
    assert (folder / "t.bin").stat().st_size == 8 * 3000


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize(
    ("name", "byte"), [("x", 255), ("y", 200), ("polarity", 126), ("polarity", 0), ("t", 255)]
)
def test_numbers_that_a_damaged_disk_made_are_refused(
    tmp_path: Path, cache: Path, name: str, byte: int
) -> None:
    events = opened(saved(tmp_path, some_events()))
    [folder] = cache.iterdir()
    with (folder / f"{name}.bin").open("r+b") as file:
        file.seek(1000 * copies.DTYPES[name].itemsize)
        file.write(bytes([byte]) * copies.DTYPES[name].itemsize)
    with pytest.raises(DataError, match="damaged; remove it"):
        events.between(0, 1)


KILLED = """
import os, sys
from pathlib import Path
from edslam_ti.event_files import checked, checks, rows
checked.IN_MEMORY = 0
rows.BLOCK = checks.BLOCK = 500
def progress(share):
    if share > 0.5:
        os.kill(os.getpid(), 9)
checked.EventFile(Path(sys.argv[1]), 32, 24, progress=progress)
"""


@pytest.mark.slow
@pytest.mark.usefixtures("copied")
def test_an_interrupted_copy_is_never_used_and_is_removed(tmp_path: Path, cache: Path) -> None:
    path = saved(tmp_path, some_events())
    assert subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False).returncode == -9
    [partial] = cache.iterdir()
    assert partial.name.endswith(".partial")
    others = cache / partial.name.replace(partial.name.split(".")[3], str(os.getpid()))
    others.mkdir()  # of a process that still runs
    assert_same(opened(path).between(0, 1), some_events())
    assert not partial.exists()
    assert others.exists()


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize("is_text", [False, True])
@pytest.mark.parametrize("fault", ["a file in its place", "no room", "disk full"])
def test_without_a_copy_events_are_the_same(
    tmp_path: Path,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    is_text: bool,
    fault: str,
) -> None:
    rows = some_events(20_000)
    rows[:, 2] = np.random.default_rng(1).permutation(rows[:, 2].reshape(-1, 100), axis=1).ravel()
    rows[7000, 0] = 99
    path = saved(tmp_path, rows)
    if is_text:
        path = text(tmp_path, "".join(line(row) for row in rows))
    expected = opened(path, is_text=is_text)
    shutil.rmtree(cache)
    if fault == "a file in its place":
        cache.write_text("")
    elif fault == "no room":
        monkeypatch.setattr(copies, "SPARE_ROOM", 10**18)
    else:

        def full(file: int) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr("edslam_ti.event_files.copies.os.fsync", full)
    caplog.clear()
    events = opened(path, is_text=is_text)
    assert "they are checked again each time" in caplog.records[0].message
    assert (len(events), events.num_dropped) == (len(expected), expected.num_dropped) == (19_999, 1)
    assert events.time_range == expected.time_range
    for k in range(10):
        a, b = (e.between(0.03 * k, 0.03 * (k + 1)) for e in (events, expected))
        assert all((getattr(a, name) == getattr(b, name)).all() for name in ("x", "y", "t", "polarity"))
    assert not cache.is_dir() or not list(cache.iterdir())


def test_a_long_first_reading_is_followed(tmp_path: Path) -> None:
    shares: list[float] = []
    opened(saved(tmp_path, some_events(300_000)), progress=shares.append)
    assert shares == sorted(shares)
    assert len(shares) > 2
    assert shares[-1] == 1


@pytest.mark.slow
@pytest.mark.usefixtures("copied")
def test_a_burst_needs_no_additional_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    monkeypatch.setenv("EDSLAM_CACHE", str(tmp_path / "cache"))
    count = 4_000_000  # 52 MB in one slice
    rows = np.lib.format.open_memmap(tmp_path / "e.npy", "w+", "<f8", (count, 4))
    rows[:, 2] = np.arange(count) * 1e-9
    rows[:, 3] = 1
    rows.flush()
    del rows
    events = opened(tmp_path / "e.npy")
    before = psutil.Process().memory_full_info().uss
    burst = events.between(0, 1)
    assert sum(int(piece.x.sum()) + len(piece) for piece in burst.pieces(1_000_000)) == count
    private = psutil.Process().memory_maps(grouped=False)
    assert not any(m.private_dirty > 20e6 for m in private if m.path.endswith(".bin"))
    assert psutil.Process().memory_full_info().uss - before < 60e6


# --- bad rows ---


BAD = {
    "x outside": ((0, WIDTH), "expected x in 0 to 31 and y in 0 to 23, got x, y, t, p = 32, "),
    "x huge": ((0, 1e12), "expected x in 0 to 31"),
    "x nan": ((0, np.nan), "expected x in 0 to 31"),
    "x between pixels": ((0, 1.5), "expected x in 0 to 31"),
    "y negative": ((1, -1), "expected x in 0 to 31"),
    "time nan": ((2, np.nan), "expected a finite time"),
    "time inf": ((2, -np.inf), "expected a finite time"),
    "time long ago": ((2, -5.0), "expected stamps in order"),
    "time far ahead": ((2, 1e9), "expected stamps in order"),
    "time a little early": ((2, 0.1), "expected stamps in order"),
    "polarity 2": ((3, 2), "expected polarity"),
    "polarity 0": ((3, 0), "expected polarity"),
    "polarity nan": ((3, np.nan), "expected polarity"),
}


@pytest.mark.parametrize("row", [499, 500, 1700])
@pytest.mark.parametrize("case", BAD)
@pytest.mark.usefixtures("copied")
def test_a_single_bad_row_is_left_out_and_noted(tmp_path: Path, case: str, row: int) -> None:
    (column, value), reason = BAD[case]
    rows = some_events(end=3.0)
    rows[row, column] = value
    events = opened(saved(tmp_path, rows))
    assert_same(events.between(-np.inf, np.inf), np.delete(rows, row, 0))
    assert events.num_dropped == 1
    [note] = events.notes
    assert note.startswith(f"1 of 3000 rows is bad and left out, first row {row}: {reason}")
    again = opened(tmp_path / "e.npy")  # from the copy
    assert (again.num_dropped, again.notes) == (1, events.notes)


def test_bad_rows_next_to_gaps_do_not_remove_good_ones(tmp_path: Path) -> None:
    rows = some_events(end=3.0)
    rows[1000:, 2] += 10
    rows[2000:, 2] += 10
    rows[[998, 2001], 2] = [50, -3]
    events = opened(saved(tmp_path, rows))
    assert_same(events.between(-np.inf, np.inf), np.delete(rows, [998, 2001], 0))


@pytest.mark.usefixtures("copied")
def test_stale_first_stamps_are_left_out(tmp_path: Path) -> None:
    rows = some_events()
    rows[:5, 2] += 1000
    assert_same(opened(saved(tmp_path, rows)).between(-np.inf, np.inf), rows[5:])


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize("row", [0, 4, -1, -5])
@pytest.mark.parametrize("time", [-3600.0, 3600.0, 1.6e9])
def test_a_few_stamps_of_another_time_at_the_ends_are_left_out(tmp_path: Path, row: int, time: float) -> None:
    rows = some_events()
    ends = slice(0, row + 1) if row >= 0 else slice(row, None)
    rows[ends, 2] = time
    events = opened(saved(tmp_path, rows))
    kept = np.delete(rows, ends, 0)
    assert_same(events.between(-np.inf, np.inf), kept)
    assert events.num_dropped == 3000 - len(kept)
    assert "expected stamps in order" in events.notes[0]


def test_a_quiet_start_is_not_left_out_as_another_time(tmp_path: Path) -> None:
    rows = some_events(end=10.0)
    rows[3:, 2] += 90
    assert_same(opened(saved(tmp_path, rows)).between(-np.inf, np.inf), rows)


def test_more_than_a_share_is_refused(tmp_path: Path) -> None:
    rows = some_events()
    rows[:30, 0] = -1  # one percent
    assert opened(saved(tmp_path, rows)).num_dropped == 30
    rows[30, 0] = -1
    with pytest.raises(DataError, match=r"row 0: expected x .* = -1, .*; 31 of 3000 rows are bad$"):
        opened(saved(tmp_path, rows))


@pytest.mark.usefixtures("copied")
def test_a_bad_stretch_of_a_long_file_is_refused(tmp_path: Path) -> None:
    rows = some_events(20_000)
    rows[10_000:10_060, 0] = -1  # 0.3 % of all, 1.5 % of eight blocks
    with pytest.raises(DataError, match=r"row 10000: .*; 60 of 4000 rows are bad$"):
        opened(saved(tmp_path, rows))
    assert checks.WINDOW == 8


def test_the_reported_reason_is_the_most_frequent_one(tmp_path: Path) -> None:
    rows = some_events()
    rows[5, 0] = 99
    rows[:, 3] = np.arange(3000) % 4
    with pytest.raises(DataError, match=r"row 2: expected polarity .* = .*, 2 \("):
        opened(saved(tmp_path, rows))


@pytest.mark.parametrize("polarity", [1, -1, 0])
def test_events_of_one_polarity_are_read(tmp_path: Path, polarity: int) -> None:
    rows = some_events()
    rows[:, 3] = polarity
    assert set(opened(saved(tmp_path, rows)).between(0, 1).polarity) == {1 if polarity == 1 else -1}


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize("milliseconds", [1, 4])
def test_a_little_disorder_is_sorted(tmp_path: Path, milliseconds: int) -> None:
    rows = some_events(20_000)
    block = np.floor(rows[:, 2] * 1000 / milliseconds)
    shuffled = rows[np.argsort(block + np.random.default_rng(1).random(len(rows)) * 0.99)]
    events = opened(saved(tmp_path, shuffled))
    assert_same(events.between(0, 1), rows)
    assert events.num_dropped == 0


@pytest.mark.usefixtures("copied")
def test_equal_stamps_stay_in_their_order(tmp_path: Path) -> None:
    rows = some_events(20_000)
    rows[:, 2] = np.floor(rows[:, 2] * 200) / 200
    assert_same(opened(saved(tmp_path, rows)).between(0, 1), rows)


@pytest.mark.parametrize("milliseconds", [33, 100])
def test_much_disorder_is_refused(tmp_path: Path, milliseconds: int) -> None:
    rows = some_events(20_000)
    block = np.floor(rows[:, 2] * 1000 / milliseconds)
    shuffled = rows[np.argsort(block + np.random.default_rng(1).random(len(rows)) * 0.99)]
    with pytest.raises(DataError, match="sort the events by time"):
        opened(saved(tmp_path, shuffled))


# --- arrays ---


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize("names", [("x", "y", "t", "p"), ("t", "x", "y", "polarity"), ("p", "ts", "y", "x")])
def test_structured_arrays_are_read_by_their_names(tmp_path: Path, names: tuple[str, ...]) -> None:
    rows = some_events()
    kinds = {"x": "u2", "y": "u2", "t": "f8", "p": "i1"}
    table = np.empty(len(rows), [(name, kinds[name[0]]) for name in names])
    for name in names:
        table[name] = rows[:, "xytp".index(name[0])]
    assert_same(opened(saved(tmp_path, table)).between(0, 1), rows)


@pytest.mark.parametrize("order", ["txyp", "xypt"])
def test_columns_in_another_order_are_detected(tmp_path: Path, order: str) -> None:
    rows = some_events()
    events = opened(saved(tmp_path, rows[:, ["xytp".index(name) for name in order]]))
    assert_same(events.between(0, 1), rows)
    assert events.notes == (f"columns look like {' '.join(order)} and are read in that order",)
    rows[:, 2] *= 1e6
    message = rf"columns look like {' '.join(order)}; .* \[:, {order.index('t')}\] by 1e6"
    with pytest.raises(DataError, match=message):
        opened(saved(tmp_path, rows[:, ["xytp".index(name) for name in order]]))


def header(text: str) -> bytes:
    body = text.encode() + b" " * 20 + b"\n"
    return b"\x93NUMPY\x01\x00" + len(body).to_bytes(2, "little") + body + bytes(64)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 4)}"), r"shape \(-1, 4\)"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (True, 4)}"), r"shape \(True, 4\)"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (2, True)}"), r"shape \(2, True\)"),
        (header("(((((((((("), "not readable as a NumPy"),
        (header("(" * 5000), "not readable as a NumPy"),
        (header("[" * 5000 + "]" * 5000), "not readable as a NumPy"),
        (header("{'descr': '|O', 'fortran_order': False, 'shape': (2, 4)}"), "element type object"),
        (header("{'descr': [('x', '|O')], 'fortran_order': False, 'shape': (2,)}"), "expected fields x, y"),
        (header("{'descr': '<c8', 'fortran_order': False, 'shape': (2, 4)}"), "element type complex64"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (4, 9)}"), "save its transpose"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (10**18, 4)}"), "not readable"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000000, 4)}"), "truncated"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': ()}"), r"got shape \(\)"),
        (header("{'descr': '<f8', 'fortran_order': 2, 'shape': (1, 4)}"), "not readable"),
        (b"\x93NUMPY\x01\x00", "not readable"),
        (b"\x93NUMPY\x09\x00" + bytes(50), "not readable"),
        (b"\x93NUMPY\x01\x00\xff\xff" + b"a" * 70_000, "not readable"),
    ],
)  # fmt: skip
def test_headers_at_fault_are_refused_in_a_short_line(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "e.npy").write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        opened(tmp_path / "e.npy")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


# --- text ---


def line(row: np.ndarray) -> str:
    return f"{row[2]!r} {row[0]:.0f} {row[1]:.0f} {row[3]:.0f}\n".replace("np.float64(", "").replace(")", "")


def text(folder: Path, content: str | bytes) -> Path:
    (folder / "events.txt").write_bytes(content if isinstance(content, bytes) else content.encode())
    return folder / "events.txt"


LINES = "".join(line(row) for row in some_events())
MIDDLE = len(LINES[:40_000].rsplit("\n", 1)[0]) + 1
NUMBER = LINES[:MIDDLE].count("\n") + 1  # of the line that begins at MIDDLE


@pytest.mark.parametrize(
    "content",
    [
        LINES,
        LINES.replace("\n", "\r\n"),
        LINES.replace("\n", "\r"),
        "\ufeff" + LINES,
        f"{WIDTH} {HEIGHT}\n" + LINES,
        "#!events.txt\n# Format: time (float s), x, y, polarity\n" + LINES,
        "# Gerät\n".encode("latin-1") + LINES.encode(),
        "\n  \n" + LINES + "\n\n",
        "t x y p\n" + LINES,
        LINES.replace(" ", ","),
        LINES.replace(" ", "\t"),
        LINES[:MIDDLE] + "# a comment\n\n" + LINES[MIDDLE:],
        LINES.removesuffix("\n"),
    ],
)
def test_texts_are_read_as_programs_write_them(
    tmp_path: Path, content: str | bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("edslam_ti.event_files.text.CHUNK", 1000)
    events = opened(text(tmp_path, content), is_text=True)
    assert_same(events.between(0, 1), some_events())
    assert (events.num_dropped, events.notes) == (0, ())


@pytest.mark.usefixtures("copied")
def test_a_text_is_parsed_once(tmp_path: Path, cache: Path) -> None:
    path = text(tmp_path, LINES)
    opened(path, is_text=True)
    [folder] = cache.iterdir()
    written = folder.stat().st_mtime_ns
    assert len(opened(path, is_text=True)) == 3000
    assert folder.stat().st_mtime_ns == written
    text(tmp_path, LINES + "0.3 1 1 1\n")
    assert len(opened(path, is_text=True)) == 3001


def test_a_last_line_that_is_cut_off_is_left_out(tmp_path: Path) -> None:
    events = opened(text(tmp_path, LINES + "0.31 17 2"), is_text=True)
    assert_same(events.between(0, 1), some_events())
    assert events.num_dropped == 1
    assert events.notes == ("line 3001, the last one, is cut off and left out: '0.31 17 2'",)


@pytest.mark.parametrize(
    "garbage", ["nan nan", "0.1 one 2 1", "1 2 3 4 5", "\x00\x01\x02", "0.1 3_1 2 1", "é"]
)
def test_a_line_of_garbage_is_left_out(tmp_path: Path, garbage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edslam_ti.event_files.text.CHUNK", 1000)
    content = "# with\n\n" + LINES[:MIDDLE] + garbage + "\n" + LINES[MIDDLE:]
    events = opened(text(tmp_path, content), is_text=True)
    assert_same(events.between(0, 1), some_events())
    assert events.num_dropped == 1
    [note] = events.notes
    assert note.startswith(f"1 of 3001 lines is bad and left out, first line {NUMBER + 2}: expected 4 num")
    assert note.isprintable()


def columns(order: str, time: float = 1.0) -> str:
    rows = some_events() * [1, 1, time, 1]
    return "".join(" ".join(f"{row['xytp'.index(c)]:.12g}" for c in order) + "\n" for row in rows)


@pytest.mark.parametrize("order", ["xytp", "xypt"])
def test_columns_of_a_text_are_detected(tmp_path: Path, order: str) -> None:
    events = opened(text(tmp_path, columns(order)), is_text=True)
    assert events.between(0, 1).t == pytest.approx(some_events()[:, 2], abs=1e-12)
    assert (events.between(0, 1).x == some_events()[:, 0]).all()
    assert events.notes == (f"columns look like {' '.join(order)} and are read in that order",)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("\n\n", r"expected lines 't x y p', got none"),
        ("# only this\n", r"expected lines 't x y p', got none"),
        (f"{WIDTH + 1} {HEIGHT}\n" + LINES, r"line 1: width and height 33 24 differ from the camera's 32 24"),
        (columns("txyp", 1e6), r"expected times in seconds, .*: divide column 1 by 1e6 or 1e9"),
        (columns("txyp", 1e9), r"expected times in seconds, .*: divide column 1 by 1e6 or 1e9"),
        (columns("xypt", 1e6), r"columns look like x y p t; .*: divide column 4 by 1e6 or 1e9"),
        (columns("xypt", 1e6).replace(" ", ","), r"columns look like x y p t; .* column 4"),
        (LINES.encode("utf-16"), r"line 1: expected plain text, got UTF-16"),
        (bytes(range(256)) * 100, r"expected plain text|expected 4 numbers"),
        (LINES[:MIDDLE] + "what is this\n" * 40 + LINES[MIDDLE:], rf"line {NUMBER}: expected 4 numbers"),
        ("x" * 100_000, r"expected"),
        (columns("txyp").replace(" 1\n", " 2\n"), r"line \d+: expected polarity"),
    ],
)  # fmt: skip
def test_texts_that_are_none_are_refused_in_a_short_line(
    tmp_path: Path, content: str | bytes, message: str, cache: Path
) -> None:
    with pytest.raises(DataError, match=rf"events\.txt: .*{message}") as caught:
        opened(text(tmp_path, content), is_text=True)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500
    assert not cache.exists() or not list(cache.iterdir())
