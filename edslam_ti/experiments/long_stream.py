"""Measures the cost of a long stream: time per frame, and memory by its use, over time."""

import csv
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from torch import Tensor

from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, SampledSequence
from edslam_ti.memory import release_free_memory
from edslam_ti.output import atomic_file
from edslam_ti.pipeline import contrast_of, held_out_frames, make_slam
from edslam_ti.results.pictures import new_figure, save_figure
from edslam_ti.slam import Slam

WARM_UP = 10.0  # seconds of data, after which only the map may make memory grow


@dataclass(frozen=True)
class FrameCost:
    """Cost of one frame, and memory after it."""

    timestamp: float  # seconds of data
    cpu_s: float  # of the whole process
    tracking_s: float  # wall time
    mapping_s: float  # wall time
    memory_mb: float  # resident
    num_gaussians: int
    map_mb: float  # part of it: the map with its optimiser's moments
    frames_mb: float  # part of it: frames kept by the mapper (event images, depth)
    tracker_mb: float  # part of it: the tracker's keyframes, including old ones, and recent frames


def frame_costs(sequence: EventDepthSequence, config: Config) -> Iterator[FrameCost]:
    """Run the method that the settings name, without the final optimisation, and yield every frame's cost."""
    samples = SampledSequence(sequence, config.start, config.duration, config.max_interval)
    slam = make_slam(config, sequence, samples, contrast_of(config, sequence, samples))
    held_out = held_out_frames(samples, config.evaluation.hold_out_every)
    process, start = psutil.Process(), float(samples.timestamps[0])
    for k, sample in enumerate(samples):
        tracking, mapping, cpu = slam.tracking_seconds, slam.mapping_seconds, time.process_time()
        slam.process(sample, is_held_out=k in held_out)
        if slam.mapper is not None:
            release_free_memory()  # as the pipeline does
        yield FrameCost(
            sample.timestamp - start,
            time.process_time() - cpu,
            slam.tracking_seconds - tracking,
            slam.mapping_seconds - mapping,
            process.memory_info().rss / 2**20,
            0 if slam.mapper is None else slam.mapper.num_gaussians,
            *_held_mb(slam),
        )


def _held_mb(slam: Slam) -> tuple[float, float, float]:
    """Return the megabytes held by the map, by the rest of the mapper, and by the tracker."""
    counted: set[int] = set()  # shared memory counts for the first owner
    the_map = None if slam.mapper is None else slam.mapper.map
    held = [held_bytes(part, counted) / 2**20 for part in (the_map, slam.mapper, slam.tracker)]
    return held[0], held[1], held[2]


def held_bytes(root: Any, counted: set[int]) -> int:
    """Return the bytes of all arrays reachable from an object of this package; shared memory counts once.

    `counted`: addresses counted before; new ones are added. Memory-mapped files do not count.
    """
    total, waiting, visited = 0, [root], set[int]()
    while waiting:
        value = waiting.pop()
        if id(value) in visited:
            continue
        visited.add(id(value))
        if isinstance(value, Tensor):
            total += _newly_counted(
                value.untyped_storage().data_ptr(), value.untyped_storage().nbytes(), counted
            )
        elif isinstance(value, np.ndarray):
            while isinstance(value.base, np.ndarray):
                value = value.base
            if isinstance(value, np.memmap):
                continue
            total += _newly_counted(value.__array_interface__["data"][0], value.nbytes, counted)
        elif isinstance(value, dict):
            waiting += value.values()
        elif isinstance(value, list | tuple | set | deque):
            waiting += value
        elif type(value).__module__.startswith(("edslam_ti", "kernels")):
            waiting += vars(value).values() if hasattr(value, "__dict__") else ()
    return total


def _newly_counted(address: int, size: int, counted: set[int]) -> int:
    """Return `size`, or 0 if the memory at this address has been counted."""
    is_new = size > 0 and address not in counted
    counted.add(address)
    return size if is_new else 0


@dataclass(frozen=True)
class Window:
    """A few seconds of data: mean time per frame, peak memory, and the map at their end."""

    start: float  # seconds of data
    end: float
    cpu_s: float  # per frame
    memory_mb: float  # maximum after any frame; it falls whenever free memory is returned to the system
    num_gaussians: int
    map_mb: float
    frames_mb: float
    tracker_mb: float

    @property
    def other_mb(self) -> float:
        """Memory of libraries, of rendering buffers, and free memory kept by the allocator."""
        return self.memory_mb - self.map_mb - self.frames_mb - self.tracker_mb


def windows(costs: Sequence[FrameCost], length: float) -> list[Window]:
    """Return the costs over every `length` seconds of data."""
    parts: dict[int, list[FrameCost]] = {}
    for cost in costs:
        parts.setdefault(int(cost.timestamp / length), []).append(cost)
    return [
        Window(
            k * length,
            (k + 1) * length,
            float(np.mean([c.cpu_s for c in part])),
            max(c.memory_mb for c in part),
            part[-1].num_gaussians,
            part[-1].map_mb,
            part[-1].frames_mb,
            part[-1].tracker_mb,
        )
        for k, part in parts.items()
    ]


def table(rows: Sequence[Window]) -> str:
    """Return a Markdown table with a line for every window, then the growth since the warm-up.

    It shows CPU time of all threads, because wall time depends on other load of the machine.
    """
    lines = [
        "| seconds of data | Gaussians | resident MB | map | frames | tracker | other | CPU s a frame |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [_line(row) for row in rows]
    warm = [r for r in rows if r.end <= WARM_UP]
    if warm and rows[-1].end > WARM_UP:
        first, last = warm[-1], rows[-1]
        num_new = last.num_gaussians - first.num_gaussians
        parts = ", ".join(
            f"{name} {getattr(last, f'{name}_mb') - getattr(first, f'{name}_mb'):+.1f}"
            for name in ("map", "frames", "tracker", "other")
        )
        lines += [
            "",
            f"Since {first.end:g} s: {last.memory_mb - first.memory_mb:+.0f} MB with {num_new:+d} Gaussians "
            f"({parts}), "
            f"CPU time a frame {100 * (last.cpu_s / first.cpu_s - 1):+.0f} %.",
        ]
    return "\n".join(lines) + "\n"


def _line(row: Window) -> str:
    return (
        f"| {row.start:g} to {row.end:g} | {row.num_gaussians / 1000:.0f}k | {row.memory_mb:.0f} | "
        f"{row.map_mb:.1f} | {row.frames_mb:.1f} | {row.tracker_mb:.1f} | {row.other_mb:.0f} | "
        f"{row.cpu_s:.2f} |"
    )


def plot(path: Path, rows: Sequence[Window]) -> None:
    """Plot time per frame, and memory with the size of the map, against seconds of data."""
    figure = new_figure(9, 3.2)
    seconds, memory = figure.subplots(1, 2)
    middle = [(r.start + r.end) / 2 for r in rows]
    seconds.plot(middle, [r.cpu_s for r in rows], "o-")
    seconds.set_ylabel("CPU seconds a frame")
    memory.plot([r.end for r in rows], [r.memory_mb for r in rows], "o-", label="resident MB")
    memory.plot(
        [r.end for r in rows], [r.num_gaussians / 1000 for r in rows], "s-", label="thousand Gaussians"
    )
    memory.legend(fontsize=8)
    for ax in (seconds, memory):
        ax.set_xlabel("seconds of data")
        ax.set_ylim(bottom=0)
        ax.grid(alpha=0.3)
    save_figure(figure, path)


def measure(
    sequence: EventDepthSequence, config: Config, out: Path, length: float, report: Callable[[str], None]
) -> None:
    """Run the sequence, report the newest line of the table every `length` seconds, and write the results.

    frames.csv, long_stream.md and long_stream.png are written when the run ends or is interrupted.
    """
    costs: list[FrameCost] = []
    try:
        for cost in frame_costs(sequence, config):
            if costs and int(cost.timestamp / length) > int(costs[-1].timestamp / length):
                report(_line(windows(costs, length)[-1]))
            costs.append(cost)
    finally:  # write partial results after Ctrl-C, too
        if costs:
            _write(out, costs, windows(costs, length))


def _write(out: Path, costs: Sequence[FrameCost], rows: Sequence[Window]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    with atomic_file(out / "frames.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([f.name for f in fields(FrameCost)])
        writer.writerows(astuple(cost) for cost in costs)
    with atomic_file(out / "long_stream.md") as temporary:
        temporary.write_text(table(rows))
    plot(out / "long_stream.png", rows)
