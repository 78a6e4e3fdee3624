"""Events that are read in place: every number that the files hold, whatever the layout."""

from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import pytest

from edslam_ti.errors import DataError
from edslam_ti.event_files import EventStream, open_events
from edslam_ti.events import Events

SIZE = (64, 48)
ZSTD = hdf5plugin.Zstd()
BLOSC = hdf5plugin.Blosc(cname="zstd")


def some_columns(count: int = 5000, seed: int = 0) -> dict[str, np.ndarray]:
    """Return random events of half a second with stamps in microseconds."""
    random = np.random.default_rng(seed)
    return {
        "x": random.integers(0, SIZE[0], count).astype(np.uint16),
        "y": random.integers(0, SIZE[1], count).astype(np.uint16),
        "t": np.sort(random.integers(0, 500_000, count)).astype(np.uint32),
        "p": random.integers(0, 2, count).astype(np.uint8),
    }


def index_by_ms(t: np.ndarray) -> np.ndarray:
    """Return for each millisecond the first event that is not earlier."""
    return np.searchsorted(t, 1000 * np.arange(int(t[-1]) // 1000 + 1)).astype(np.uint64)


def write_dsec(path: Path, columns: dict[str, np.ndarray], offset: int | None = None, **how: Any) -> Path:
    """Write the layout of DSEC; without offset that of TUM-VIE."""
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file.create_dataset(f"events/{name}", data=values, chunks=(1000,), **how)
        file["ms_to_idx"] = index_by_ms(columns["t"])
        if offset is not None:
            file["t_offset"] = np.int64(offset)
    return path


def assert_same(events: Events, columns: dict[str, np.ndarray], seconds: np.ndarray) -> None:
    assert (events.x == columns["x"]).all()
    assert (events.y == columns["y"]).all()
    assert (events.polarity == np.where(columns["p"] > 0, 1, -1)).all()
    assert (events.t == seconds).all()
    assert [a.dtype for a in (events.x, events.y, events.t, events.polarity)] == ["i2", "i2", "f8", "i1"]


def everything(stream: EventStream) -> Events:
    first, last = stream.time_range
    return stream.between(first, np.nextafter(last, np.inf))


@pytest.mark.parametrize(
    ("offset", "how"), [(None, {}), (51_648_500_123, dict(ZSTD)), (1_642_661_139_000_001, dict(BLOSC))]
)
def test_dsec_layout(tmp_path: Path, offset: int | None, how: dict[str, Any]) -> None:
    columns = some_columns()
    stream = open_events(write_dsec(tmp_path / "events.h5", columns, offset, **how), SIZE)
    seconds = (columns["t"].astype(np.int64) + (offset or 0)) / 1e6
    assert len(stream) == 5000
    assert stream.size is None
    assert stream.notes == ()
    assert stream.time_range == (seconds[0], seconds[-1])
    assert_same(everything(stream), columns, seconds)


def test_stamps_since_the_epoch_lose_nothing_when_they_are_shifted(tmp_path: Path) -> None:
    columns = some_columns()
    stream = open_events(write_dsec(tmp_path / "e.h5", columns, 1_642_661_139_000_000), SIZE)
    shifted = stream.shifted(1_642_661_139.0)
    assert_same(everything(shifted), columns, columns["t"] / 1e6)
    inside = (columns["t"] >= 100_000) & (columns["t"] < 200_000)
    assert_same(
        shifted.between(0.1, 0.2), {k: v[inside] for k, v in columns.items()}, columns["t"][inside] / 1e6
    )


def test_the_camera_is_chosen_and_its_size_is_read(tmp_path: Path) -> None:
    sides = {side: some_columns(seed=k) for k, side in enumerate(("left", "right"))}
    with h5py.File(tmp_path / "m3ed.h5", "w") as file:
        for side, columns in sides.items():
            for name, values in columns.items():
                file[f"prophesee/{side}/{name}"] = values.astype(np.int64) if name == "t" else values
            file[f"prophesee/{side}/ms_map_idx"] = index_by_ms(columns["t"])
            file[f"prophesee/{side}/calib/resolution"] = np.array(SIZE)
    for group, side in ((None, "left"), ("left", "left"), ("prophesee/right", "right"), ("/right", "right")):
        stream = open_events(tmp_path / "m3ed.h5", group=group)
        assert stream.size == SIZE
        assert_same(everything(stream), sides[side], sides[side]["t"] / 1e6)
        assert bool(stream.notes) == (group is None)
    with pytest.raises(DataError, match="none of its groups with events fit 'middle'"):
        open_events(tmp_path / "m3ed.h5", group="middle")


def test_mvsec_layout(tmp_path: Path) -> None:
    columns = some_columns()
    seconds = 1_504_645_177.0 + columns["t"] / 1e6
    signs = np.where(columns["p"] > 0, 1.0, -1.0)
    with h5py.File(tmp_path / "indoor_flying1_data.hdf5", "w") as file:
        file["davis/left/events"] = np.stack([columns["x"], columns["y"], seconds, signs], 1)
        file["davis/left/image_raw"] = np.zeros((2, SIZE[1], SIZE[0]), np.uint8)
        file["davis/left/image_raw_event_inds"] = np.arange(2)
    stream = open_events(tmp_path / "indoor_flying1_data.hdf5")
    assert stream.size == SIZE
    assert_same(everything(stream), columns, seconds)


def test_columns_in_a_folder(tmp_path: Path) -> None:
    columns = some_columns()
    for name, values in columns.items():
        np.save(tmp_path / f"{name}.npy", values)
    assert_same(everything(open_events(tmp_path, SIZE)), columns, columns["t"] / 1e6)
    np.save(tmp_path / "t.npy", columns["t"] / 1e6)
    np.save(tmp_path / "p.npy", columns["p"].astype(bool))
    assert_same(everything(open_events(tmp_path, SIZE)), columns, columns["t"] / 1e6)
