"""Times the front end: first opening of a recording, reading, counting, time surface."""

import importlib.util
import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.config import TimeSurfaceConfig
from edslam_ti.datasets.base import Sample
from edslam_ti.event_files import EventStream, open_events
from edslam_ti.event_files.checked import IN_MEMORY
from edslam_ti.event_images.change import BrightnessChange
from edslam_ti.experiments.kernel_times import OURS, Row, Stopwatch, Work
from edslam_ti.frame import FrameBuilder
from edslam_ti.output import write_npy_header
from edslam_ti.tracking.surfaces import SurfaceFrameBuilder

RATE = 20e6  # events per second of the recording, as of a fast sensor in fast motion
NUM_SLICES = 4  # of the recording
AT_ONCE = 1_000_000  # events generated at once
BYTES_PER_EVENT = 13  # bytes read per event
COLUMNS = {"x": "<u2", "y": "<u2", "t": "<u4", "p": "|u1"}  # as DSEC, VECtor and others store them
HDF5_CHUNK = 65_536  # events


def write_recording(path: Path, size: tuple[int, int], count: int) -> None:
    """Write random events at `RATE` as an array [count, 4] of float64."""
    rng = np.random.default_rng(0)
    with path.open("wb") as file:
        write_npy_header(file, np.dtype("<f8"), count, 4)
        for start in range(0, count, AT_ONCE):
            number = min(AT_ONCE, count - start)
            rows = np.empty((number, 4))
            for k in range(2):
                rows[:, k] = rng.integers(0, size[k], number)
            rows[:, 2] = (start + np.arange(number)) / RATE
            rows[:, 3] = 2 * rng.integers(0, 2, number) - 1
            file.write(rows.tobytes())


def write_columns(folder: Path, size: tuple[int, int], count: int) -> Path:
    """Write random events at `RATE` as a folder of arrays x.npy, y.npy, t.npy [us], p.npy."""
    folder.mkdir()
    with ExitStack() as stack:
        files = {name: stack.enter_context((folder / f"{name}.npy").open("wb")) for name in COLUMNS}
        for name, dtype in COLUMNS.items():
            header = {"descr": dtype, "fortran_order": False, "shape": (count,)}
            np.lib.format.write_array_header_1_0(files[name], header)
        for part in _parts(size, count):
            for name, values in part.items():
                files[name].write(values.tobytes())
    return folder


def write_hdf5(path: Path, size: tuple[int, int], count: int) -> Path:
    """Write random events at `RATE` in DSEC's layout, compressed as DSEC's (Blosc, Zstd)."""
    import h5py
    import hdf5plugin

    with h5py.File(path, "w") as file:
        how = hdf5plugin.Blosc(cname="zstd", clevel=1)
        chunks = (min(HDF5_CHUNK, count),)
        columns = {
            name: file.create_dataset(f"events/{name}", (count,), dtype, chunks=chunks, **how)
            for name, dtype in COLUMNS.items()
        }
        start = 0
        for part in _parts(size, count):
            for name, values in part.items():
                columns[name][start : start + len(values)] = values
            start += len(part["t"])
        per_ms = RATE / 1000
        file["ms_to_idx"] = np.arange(int((count - 1) / per_ms) + 1, dtype=np.uint64) * np.uint64(per_ms)
    return path


def _parts(size: tuple[int, int], count: int) -> Iterator[dict[str, np.ndarray]]:
    """Yield columns of `AT_ONCE` random events."""
    rng = np.random.default_rng(0)
    for start in range(0, count, AT_ONCE):
        number = min(AT_ONCE, count - start)
        stamps = (start + np.arange(number)) * (1e6 / RATE)
        values = (rng.integers(0, size[0], number), rng.integers(0, size[1], number), stamps)
        columns = dict(zip("xytp", (*values, rng.integers(0, 2, number))))
        yield {name: columns[name].astype(dtype) for name, dtype in COLUMNS.items()}


def front_end(size: tuple[int, int], count: int, watch: Stopwatch) -> Iterator[Row]:
    """Time the opening of a recording in several layouts, and the processing of its slices.

    A slice holds `count` events; slices are processed one by one.
    """
    total = max(NUM_SLICES * count, IN_MEMORY + 1)
    with tempfile.TemporaryDirectory() as name, _cache_in(name):
        folder = Path(name)
        recording = folder / "events.npy"
        write_recording(recording, size, total)

        def check() -> EventStream:
            os.utime(recording)  # a new modification time makes it be checked again
            return open_events(recording, size)

        task = f"{size[0]}x{size[1]}, {total} events: check and copy"
        work = Work((32 + BYTES_PER_EVENT) * total)
        yield from watch.compare("front_end", task, {OURS: check}, work)
        yield from _processing(check(), size, count, watch, "")
        columns = write_columns(folder / "columns", size, total)
        yield from _in_place(columns, size, count, watch, "npy columns")
        if importlib.util.find_spec("hdf5plugin") is not None:
            hdf5 = write_hdf5(folder / "events.h5", size, total)
            yield from _in_place(hdf5, size, count, watch, "HDF5")


def _in_place(path: Path, size: tuple[int, int], count: int, watch: Stopwatch, layout: str) -> Iterator[Row]:
    """Time a recording that is read without conversion."""
    task = f"{size[0]}x{size[1]}, {layout}: open"
    yield from watch.compare("front_end", task, {OURS: lambda: open_events(path, size)}, Work())
    yield from _processing(open_events(path, size), size, count, watch, f"{layout}, ")


def _processing(
    events: EventStream, size: tuple[int, int], count: int, watch: Stopwatch, layout: str
) -> Iterator[Row]:
    camera = Camera(*size, size[0] / 2, size[0] / 2, (size[0] - 1) / 2, (size[1] - 1) / 2)
    builder, change = FrameBuilder(camera), BrightnessChange(camera.shape, 0.1, 0.1)
    surfaces = SurfaceFrameBuilder(camera, TimeSurfaceConfig())
    length, num_slices = count / RATE, len(events) // count
    taken = 0

    def take_in() -> None:
        nonlocal taken
        k = taken % num_slices
        taken += 1
        part = events.between(k * length, (k + 1) * length)
        frame = builder.build(Sample((k + 1) * length, part, None))
        change.add(frame.event_counts)
        change.log_brightness()
        surfaces.build(frame)

    task = f"{size[0]}x{size[1]}, {layout}{count} events: read, count, time surface"
    yield from watch.compare("front_end", task, {OURS: take_in}, Work(BYTES_PER_EVENT * count))


@contextmanager
def _cache_in(folder: str) -> Iterator[None]:
    """Keep copies in a folder for a while."""
    cache = os.environ.get("EDSLAM_CACHE")
    os.environ["EDSLAM_CACHE"] = folder
    try:
        yield
    finally:
        if cache is None:
            del os.environ["EDSLAM_CACHE"]
        else:
            os.environ["EDSLAM_CACHE"] = cache
