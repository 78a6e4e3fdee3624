"""What a long stream costs: time per frame, memory and the size of the map, against the seconds of data."""

import csv
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
import psutil

from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, SampledSequence
from edslam_ti.output import atomic_file
from edslam_ti.pictures import new_figure, save_figure
from edslam_ti.pipeline import contrast_of, held_out_frames, make_slam

WARM_UP = 10.0  # seconds of data after which memory may grow by the map alone


@dataclass(frozen=True)
class FrameCost:
    """What one frame took, and what there is after it."""

    timestamp: float  # seconds of data
    cpu_s: float  # of the whole process
    tracking_s: float  # wall time
    mapping_s: float  # wall time
    memory_mb: float  # resident
    num_gaussians: int


def frame_costs(sequence: EventDepthSequence, config: Config) -> Iterator[FrameCost]:
    """Run the method that the settings name, without its end, and yield what every frame cost."""
    samples = SampledSequence(sequence, config.start, config.duration, config.max_interval)
    slam = make_slam(config, sequence, samples, contrast_of(config, sequence, samples))
    held_out = held_out_frames(samples, config.evaluation.hold_out_every)
    process, start = psutil.Process(), float(samples.timestamps[0])
    for k, sample in enumerate(samples):
        tracking, mapping, cpu = slam.tracking_seconds, slam.mapping_seconds, time.process_time()
        slam.process(sample, is_held_out=k in held_out)
        yield FrameCost(
            sample.timestamp - start,
            time.process_time() - cpu,
            slam.tracking_seconds - tracking,
            slam.mapping_seconds - mapping,
            process.memory_info().rss / 2**20,
            0 if slam.mapper is None else slam.mapper.num_gaussians,
        )


@dataclass(frozen=True)
class Stretch:
    """Means over a few seconds of data; memory and the map at their end."""

    start: float  # seconds of data
    end: float
    cpu_s: float  # a frame
    memory_mb: float
    num_gaussians: int


def stretches(costs: Sequence[FrameCost], length: float) -> list[Stretch]:
    """Return the costs of every `length` seconds of data."""
    parts: dict[int, list[FrameCost]] = {}
    for cost in costs:
        parts.setdefault(int(cost.timestamp / length), []).append(cost)
    return [
        Stretch(
            k * length,
            (k + 1) * length,
            float(np.mean([c.cpu_s for c in part])),
            part[-1].memory_mb,
            part[-1].num_gaussians,
        )
        for k, part in parts.items()
    ]


def table(rows: Sequence[Stretch]) -> str:
    """Return Markdown: a line for every stretch, then what has grown since the warm-up.

    CPU time of all threads: wall time says more about what else the machine does.
    """
    lines = [
        "| seconds of data | Gaussians | resident MB | CPU s a frame |",
        "|---|---|---|---|",
    ]
    lines += [_line(row) for row in rows]
    warm = [r for r in rows if r.end <= WARM_UP]
    if warm and rows[-1].end > WARM_UP:
        first, last = warm[-1], rows[-1]
        num_new = last.num_gaussians - first.num_gaussians
        lines += [
            "",
            f"Since {first.end:g} s: {last.memory_mb - first.memory_mb:+.0f} MB with {num_new:+d} Gaussians, "
            f"CPU time a frame {100 * (last.cpu_s / first.cpu_s - 1):+.0f} %.",
        ]
    return "\n".join(lines) + "\n"


def _line(row: Stretch) -> str:
    return (
        f"| {row.start:g} to {row.end:g} | {row.num_gaussians / 1000:.0f}k | {row.memory_mb:.0f} | "
        f"{row.cpu_s:.2f} |"
    )


def plot(path: Path, rows: Sequence[Stretch]) -> None:
    """Draw time a frame, and memory with the size of the map, against seconds of data."""
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
    """Run the sequence, tell the table's newest line every `length` seconds, and write what there is.

    frames.csv, long_stream.md and long_stream.png are written when the run ends or is interrupted.
    """
    costs: list[FrameCost] = []
    try:
        for cost in frame_costs(sequence, config):
            if costs and int(cost.timestamp / length) > int(costs[-1].timestamp / length):
                report(_line(stretches(costs, length)[-1]))
            costs.append(cost)
    finally:  # what there is before Ctrl-C, too
        if costs:
            _write(out, costs, stretches(costs, length))


def _write(out: Path, costs: Sequence[FrameCost], rows: Sequence[Stretch]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    with atomic_file(out / "frames.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([f.name for f in fields(FrameCost)])
        writer.writerows(astuple(cost) for cost in costs)
    with atomic_file(out / "long_stream.md") as temporary:
        temporary.write_text(table(rows))
    plot(out / "long_stream.png", rows)
