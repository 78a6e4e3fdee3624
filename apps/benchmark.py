"""python apps/benchmark.py --suites rasterizer tracking

Time the kernels, and steps of a run, beside alternatives (torch, numpy, and numba and dv-processing where
installed) in turn in one process, and print a Markdown table; "limit" is the least time this machine could
take. What takes more than two seconds a call is timed once. --out FOLDER also writes benchmark.md and
benchmark.json there, and scaling.png for the suite `scaling`.

    python apps/benchmark.py --engines taichi quadrants           both engines of the kernels, a column each
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from edslam_ti.command_line import launch, parse_arguments
from edslam_ti.experiments.benchmark import KERNELS, Engine, Suite
from edslam_ti.experiments.benchmark import benchmark as run


def benchmark(
    suites: tuple[Suite, ...] = KERNELS,
    sizes: tuple[tuple[int, int], ...] = ((384, 240),),
    gaussians: tuple[int, ...] = (30_000,),
    events: tuple[int, ...] = (10_000, 1_000_000),
    rounds: int = 7,
    threads: int = 2,
    device: Literal["cpu", "cuda"] = "cpu",
    engines: tuple[Engine, ...] = (),
    scene: str = "office0",
    duration: float = 1.0,
    out: Path | None = None,
) -> None:
    """Time the kernels and what is built of them.

    Args:
        suites: what to time; scaling: cost against each size, and against 1 to `threads` threads
        sizes: widths and heights of images, in pairs
        gaussians: numbers of Gaussians
        events: numbers of events in a batch
        rounds: timings of each candidate, of which the median counts; one of those that take over two seconds
        threads: CPU threads of the kernels and of torch
        device: where the kernels run; alternatives stay on the CPU
        engines: engines of the kernels, the first in this process; none: the one of EDSLAM_ENGINE, or taichi
        scene: sequence of the suite slam
        duration: seconds of it
        out: folder that receives the results
    """
    run(suites, sizes, gaussians, events, rounds, threads, device, engines, scene, duration, out)


def main(argv: Sequence[str] | None = None) -> None:
    parse_arguments(benchmark, argv, description=__doc__)


if __name__ == "__main__":
    launch(main)
