"""Events that are read in place: slices, order, what is left out, what is refused."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from edslam_ti.errors import DataError, MissingExtraError
from edslam_ti.event_files import open_events, sliced
from edslam_ti.event_files.hdf5 import Hdf5Columns

SIZE = (64, 48)
COUNT = 20_000


@pytest.fixture
def in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small files are read in many blocks, and not checked as a whole when they are opened."""
    monkeypatch.setattr(sliced, "BLOCK", 500)
    monkeypatch.setattr(sliced, "AT_OPENING", 0)
    monkeypatch.setattr(sliced, "PROBE_LENGTH", 50)


def some_columns(count: int = COUNT, span: int = 2_000_000) -> dict[str, np.ndarray]:
    """Return random events of two seconds in microseconds, in the order of time."""
    random = np.random.default_rng(0)
    return {
        "x": random.integers(0, SIZE[0], count).astype(np.uint16),
        "y": random.integers(0, SIZE[1], count).astype(np.uint16),
        "t": np.sort(random.integers(0, span, count)),
        "p": random.integers(0, 2, count).astype(np.uint8),
    }


def shuffled(t: np.ndarray, by: int) -> np.ndarray:
    """Return stamps that are out of order by up to so many microseconds."""
    order = np.argsort(t + np.random.default_rng(1).integers(0, by, len(t)), kind="stable")
    return t[order]


def write(path: Path, columns: dict[str, np.ndarray], index: Any = None) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[f"events/{name}"] = values
        if index is not None:
            file["ms_to_idx"] = index
    return path


def true_index(t: np.ndarray) -> np.ndarray:
    return np.searchsorted(t, 1000 * np.arange(int(t[-1]) // 1000 + 1)).astype(np.uint64)


# --- slices ---


@pytest.mark.usefixtures("in_pieces")
@pytest.mark.parametrize("disorder", [0, 4000])
@pytest.mark.parametrize("index", ["none", "right", "wrong"])
def test_every_slice_is_exact(tmp_path: Path, disorder: int, index: str) -> None:
    columns = some_columns()
    columns["t"][5000:8000] = columns["t"][5000]  # more events with one stamp than a block holds
    columns["t"][15_000:] += 60_000_000  # a gap
    if disorder:
        columns["t"] = shuffled(columns["t"], disorder)
    indices = {"none": None, "wrong": np.zeros(100, np.uint64), "right": true_index(np.sort(columns["t"]))}
    path = write(tmp_path / "e.h5", columns, indices[index])
    stream = open_events(path, SIZE)
    assert [("does not fit" in note) for note in stream.notes] == ([True] if index == "wrong" else [])
    order = np.argsort(columns["t"], kind="stable")
    t, x = columns["t"][order] / 1e6, columns["x"][order]
    assert stream.time_range == (t[0], t[-1])
    random = np.random.default_rng(2)
    for shift in (0.0, 0.3):
        shifted = stream.shifted(shift)
        for _ in range(40):
            start = float(random.choice(t) + random.choice([0, 1e-6, -1e-3, -60]))
            end = start + float(random.choice([0, 1e-6, 1e-3, 0.05, 70]))
            found = shifted.between(start - shift, end - shift)
            inside = (t >= start) & (t < end)
            # A shift of 0.3 s is no whole number in binary, so that bounds may be met or missed.
            assert abs(len(found) - inside.sum()) <= (3001 if shift else 0)
            if shift == 0:
                assert (found.t == t[inside]).all()
                assert (found.x == x[inside]).all()
    assert len(stream.between(1, 1)) == len(stream.between(2, 1)) == len(stream.between(500, 501)) == 0
    assert stream.num_dropped == 0


@pytest.mark.usefixtures("in_pieces")
def test_opening_reads_a_few_places_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    columns = some_columns(200_000)
    path = write(tmp_path / "e.h5", columns, true_index(columns["t"]))
    number, read = [0], Hdf5Columns.read

    def counted(self: Hdf5Columns, start: int, end: int) -> Any:
        number[0] += end - start
        return read(self, start, end)

    monkeypatch.setattr(Hdf5Columns, "read", counted)
    stream = open_events(path, SIZE)
    assert number[0] < 5000
    number[0] = 0
    assert len(stream.between(1.0, 1.001)) > 50
    assert number[0] <= 3000  # a few blocks


def test_long_chunks_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edslam_ti.event_files.hdf5.CACHE", 1000)
    columns = some_columns()
    with h5py.File(tmp_path / "e.h5", "w") as file:
        for name, values in columns.items():
            file.create_dataset(f"events/{name}", data=values, chunks=(COUNT,), compression="gzip")
    assert (open_events(tmp_path / "e.h5", SIZE).between(0, 3).x == columns["x"]).all()


@pytest.mark.parametrize(
    ("coding", "dtype"),
    [((0, 1), "u1"), ((-1, 1), "i1"), ((0, 1), "?"), ((0, 1), "i2"), ((-1, 1), "f4")],
)
def test_polarity(tmp_path: Path, coding: tuple[int, int], dtype: str) -> None:
    columns = some_columns()
    signs = np.where(columns["p"] > 0, 1, -1)
    columns["p"] = np.where(columns["p"] > 0, coding[1], coding[0]).astype(dtype)
    assert (open_events(write(tmp_path / "e.h5", columns), SIZE).between(0, 3).polarity == signs).all()


@pytest.mark.parametrize(
    ("scale", "dtype", "offset"),
    [
        (1, "i8", 0),
        (1, "u4", 0),
        (1, "f8", 0),
        (1000, "i8", 1_700_000_000_000_000_000),
        (1e-6, "f8", 0),
        (1e-6, "f8", 1.7e9),
    ],
)
def test_units_of_time(tmp_path: Path, scale: float, dtype: str, offset: float) -> None:
    columns = some_columns()
    ticks = {1: 1e6, 1000: 1e9, 1e-6: 1.0}[scale]
    start = offset / ticks
    seconds = columns["t"] / 1e6 + start
    if dtype == "f8":
        columns["t"] = columns["t"] * scale + offset
    else:
        columns["t"] = (columns["t"] * int(scale) + int(offset)).astype(dtype)
    found = open_events(write(tmp_path / "e.h5", columns), SIZE).between(start - 1, start + 3)
    assert np.abs(found.t - seconds).max() <= 3e-7


# --- what is left out ---


@pytest.mark.usefixtures("in_pieces")
def test_bad_events_are_left_out_and_counted_once(tmp_path: Path) -> None:
    columns = some_columns()
    columns["t"] = columns["t"] / 1e6 + 0.1
    columns["x"] = columns["x"].astype(np.int32)
    columns["x"][100], columns["x"][7000], columns["y"][7010] = 64, -1, 48
    columns["t"][9000], columns["t"][9001], columns["p"][12_000] = np.nan, 1e6, 7
    columns["t"][0], columns["t"][-1] = 0.0001, 3e9  # the last one is from another time
    good = np.delete(np.arange(COUNT), [100, 7000, 7010, 9000, 9001, 12_000, COUNT - 1])
    stream = open_events(write(tmp_path / "e.h5", columns), SIZE)
    assert stream.time_range == (0.0001, columns["t"][-2])
    for _ in range(2):
        found = stream.between(0, 10)
        assert (found.x == columns["x"][good]).all()
        assert (found.t == columns["t"][good]).all()
        assert stream.num_dropped == 7
        assert len(stream) == COUNT - 7
        [note] = stream.notes
        assert note.startswith(f"7 of {COUNT} events are bad and left out, first event ")
    assert stream.shifted(1.0).num_dropped == 7


def test_bad_events_of_a_small_file_are_known_when_it_is_open(tmp_path: Path) -> None:
    columns = some_columns()
    columns["p"][[3, 5000]] = 2
    stream = open_events(write(tmp_path / "e.h5", columns), SIZE)
    assert (len(stream), stream.num_dropped) == (COUNT - 2, 2)
    assert "first event 3: expected polarity" in stream.notes[0]


# --- what is refused ---


def spoilt(kind: str) -> dict[str, np.ndarray]:
    columns = some_columns()
    if kind == "x":
        columns["x"] += 32
    elif kind == "swapped":
        columns["x"], columns["y"] = columns["y"], columns["x"] % 64
    elif kind == "p":
        columns["p"] = np.arange(COUNT).astype(np.uint8)
    elif kind == "jump":
        columns["t"][10_000:] -= 500_000
    elif kind == "little jump":
        columns["t"][10_123:] -= 30_000
    elif kind == "backward":
        columns["t"] = columns["t"][::-1].copy()
    elif kind == "two days":
        columns["t"] = np.linspace(0, 2e7, COUNT) + 0.5
    elif kind == "nan":
        columns["t"] = np.full(COUNT, np.nan)
    return columns


@pytest.mark.usefixtures("in_pieces")
@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("x", "expected x in 0 to 63 and y in 0 to 47"),
        ("swapped", "expected x in 0 to 63 and y in 0 to 47"),
        ("p", "expected polarity -1 or"),
        ("jump", "sort the events by time"),
        ("little jump", "sort the events by time"),
        ("backward", "sort the events by time"),
        ("two days", "expected times in seconds"),
        ("nan", "expected a finite time"),
    ],
)
def test_a_file_of_another_kind_gets_one_line(tmp_path: Path, kind: str, words: str) -> None:
    path = write(tmp_path / "e.h5", spoilt(kind))

    def read() -> None:
        stream = open_events(path, SIZE)
        for start in np.arange(0, 2, 0.1):
            stream.between(start, start + 0.1)

    with pytest.raises(DataError, match=words) as caught:
        read()
    assert "\n" not in str(caught.value)


def test_a_damaged_file_gets_one_line(tmp_path: Path) -> None:
    path = tmp_path / "e.h5"
    for spoil, words in (
        (lambda c: c.update(p=c["p"][:50]), "expected columns of one length, got x 20000"),
        (lambda c: c.pop("t"), "expected events x, y, t, p .* got events"),
        (lambda c: c.update({name: values[:0] for name, values in c.items()}), "expected events, got none"),
        (lambda c: c.update(t=c["t"].astype("S8")), "expected events x, y, t, p"),
    ):
        columns = some_columns()
        spoil(columns)
        with pytest.raises(DataError, match=words):
            open_events(write(path, columns), SIZE)
    write(path, some_columns())
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match=r"not readable as HDF5 .*truncated") as caught:
        open_events(path, SIZE)
    assert "\n" not in str(caught.value)
    with pytest.raises(DataError, match="does not state the size of its image; pass width and height"):
        open_events(write(path, some_columns()))


def test_a_damaged_chunk_gets_one_line(tmp_path: Path) -> None:
    path = tmp_path / "e.h5"
    with h5py.File(path, "w") as file:
        for name, values in some_columns().items():
            file.create_dataset(f"events/{name}", data=values, chunks=(1000,), compression="gzip")
        place = file["events/x"].id.get_chunk_info(5)
    content = bytearray(path.read_bytes())
    content[place.byte_offset : place.byte_offset + place.size] = bytes(place.size)
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"events \d+ to \d+ cannot be read") as caught:
        open_events(path, SIZE)
    assert "\n" not in str(caught.value)


def test_a_missing_compression_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "e.h5", {name: some_columns()[name] for name in "xyp"})
    with h5py.File(path, "a") as file:
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_chunk((1000,))
        settings.set_filter(32_999, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((COUNT,))
        h5py.h5d.create(file["events"].id, b"t", h5py.h5t.NATIVE_INT64, space, settings)
    with pytest.raises(MissingExtraError, match=r"filter 32999 .*pip install 'edslam-ti\[formats\]'"):
        open_events(path, SIZE)


@pytest.mark.parametrize("damage", ["cut", "lengths", "matrix", "objects"])
def test_bad_columns_get_one_line(tmp_path: Path, damage: str) -> None:
    for name, values in some_columns().items():
        np.save(tmp_path / f"{name}.npy", values)
    bad = tmp_path / "t.npy"
    if damage == "cut":
        bad.write_bytes(bad.read_bytes()[:1000])
    else:
        np.save(
            bad,
            {"lengths": np.arange(5), "matrix": np.zeros((COUNT, 2)), "objects": np.array(["a"] * COUNT)}[
                damage
            ],
        )
    with pytest.raises(
        DataError, match=r"expected (one number|arrays of one)|not readable as a NumPy"
    ) as caught:
        open_events(tmp_path, SIZE)
    assert "\n" not in str(caught.value)
