"""python apps/benchmark.py --suites rasterizer tracking

Time the kernels beside alternatives (torch, numpy) in turn in one process, and print a Markdown table.
--out FOLDER also writes benchmark.md and benchmark.json there.
"""

import dataclasses
import json
import os
import platform
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

from edslam_ti.command_line import launch, parse_arguments

Suite = Literal["rasterizer", "time_surface", "tracking"]


def processor() -> str:
    """Return the processor's name, where Linux tells it, and the number of its cores."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores"


def benchmark(
    suites: tuple[Suite, ...] = ("rasterizer", "time_surface", "tracking"),
    sizes: tuple[tuple[int, int], ...] = ((384, 240),),
    gaussians: tuple[int, ...] = (30_000,),
    events: tuple[int, ...] = (10_000, 1_000_000),
    rounds: int = 7,
    threads: int = 2,
    out: Path | None = None,
) -> None:
    """Time the kernels on the CPU.

    Args:
        suites: what to time
        sizes: widths and heights of images, in pairs
        gaussians: numbers of Gaussians
        events: numbers of events in a batch
        rounds: timings of each candidate, of which the median counts
        threads: CPU threads of the kernels and of torch
        out: folder that receives benchmark.md and benchmark.json
    """
    import torch  # torch and Taichi take seconds to load

    import kernels
    from kernels import benchmark as timed

    kernels.init("cpu", threads=threads)
    torch.set_num_threads(threads)
    machine = f"{processor()}, {threads} threads, torch {torch.__version__}"

    def rows() -> Iterator[timed.Row]:
        for size in sizes:
            for count in gaussians if "rasterizer" in suites else ():
                yield from timed.rasterizer(size, count, rounds)
            for count in events if "time_surface" in suites else ():
                yield from timed.surface(size, count, rounds)
            if "tracking" in suites:
                yield from timed.tracking(size, rounds)

    lines = [f"{machine}; medians of {rounds}", ""]
    lines += ["| task | | wall ms | CPU ms | wall / ours |", "|---|---|--:|--:|--:|"]
    print("\n".join(lines))
    results = []
    for row in rows():
        results.append(dataclasses.asdict(row))
        times = f"{row.wall_ms:.3g} | {row.cpu_ms:.3g} | {row.times_ours:.2f}"
        lines.append(f"| {row.task} | {row.name} | {times} |")
        print(lines[-1], flush=True)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "benchmark.md").write_text("\n".join(lines) + "\n")
        content = json.dumps({"machine": machine, "rows": results}, indent=2)
        (out / "benchmark.json").write_text(content + "\n")


def main(argv: Sequence[str] | None = None) -> None:
    parse_arguments(benchmark, argv, description=__doc__)


if __name__ == "__main__":
    launch(main)
