"""Times the front end: first opening of a recording, reading, counting, time surface."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.config import TimeSurfaceConfig
from edslam_ti.datasets.base import Sample
from edslam_ti.event_files.checked import IN_MEMORY, EventFile
from edslam_ti.event_images.change import BrightnessChange
from edslam_ti.experiments.kernel_times import OURS, Row, Stopwatch, Work
from edslam_ti.frame import FrameBuilder
from edslam_ti.output import write_npy_header
from edslam_ti.tracking.surfaces import SurfaceFrameBuilder

RATE = 20e6  # events per second of the recording, as of a fast sensor in fast motion
NUM_SLICES = 4  # of the recording
AT_ONCE = 1_000_000  # events generated at once
BYTES_PER_EVENT = 13  # bytes read per event


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


def front_end(size: tuple[int, int], count: int, watch: Stopwatch) -> Iterator[Row]:
    """Time the check of a recording, and the processing of its slices of `count` events one by one."""
    total = max(NUM_SLICES * count, IN_MEMORY + 1)
    camera = Camera(*size, size[0] / 2, size[0] / 2, (size[0] - 1) / 2, (size[1] - 1) / 2)
    cache = os.environ.get("EDSLAM_CACHE")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["EDSLAM_CACHE"] = folder
        try:
            recording = Path(folder) / "events.npy"
            write_recording(recording, size, total)

            def check() -> EventFile:
                os.utime(recording)  # a new modification time makes it be checked again
                return EventFile(recording, *size)

            task = f"{size[0]}x{size[1]}, {total} events: check and copy"
            work = Work((32 + BYTES_PER_EVENT) * total)
            yield from watch.compare("front_end", task, {OURS: check}, work)
            events = check()
        finally:
            if cache is None:
                del os.environ["EDSLAM_CACHE"]
            else:
                os.environ["EDSLAM_CACHE"] = cache
        builder, change = FrameBuilder(camera), BrightnessChange(camera.shape, 0.1, 0.1)
        surfaces = SurfaceFrameBuilder(camera, TimeSurfaceConfig())
        length, num_slices = count / RATE, total // count
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

        task = f"{size[0]}x{size[1]}, {count} events: read, count, time surface"
        yield from watch.compare("front_end", task, {OURS: take_in}, Work(BYTES_PER_EVENT * count))
