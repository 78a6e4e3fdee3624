"""edslam benchmark --suites rasterizer tracking

Time the kernels, and steps of a run, beside alternatives (torch, numpy, and numba and dv-processing where
installed) in turn in one process, and print a Markdown table; "limit" is the least time this machine could
take. What takes more than two seconds a call is timed once. --out FOLDER also writes benchmark.md and
benchmark.json there, and scaling.png for the suite `scaling`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from edslam_ti.arguments import read_options
from edslam_ti.cold_start import load_kernels
from edslam_ti.config import Stage
from edslam_ti.errors import EdSlamError

Suite = Literal["time_surface", "tracking", "rasterizer", "mapping_step", "cold_start", "slam", "scaling"]
KERNELS: tuple[Suite, ...] = ("time_surface", "tracking", "rasterizer", "mapping_step")
HEADER = (
    "| task | | wall ms | CPU ms | wall / first | CPU / first | limit ms |\n|---|---|--:|--:|--:|--:|--:|"
)


class BenchmarkOptions(Stage):
    """What to time, and at which sizes."""

    suites: tuple[Suite, ...] = KERNELS
    """What to time; scaling: cost against each size, and against 1 to `threads` threads."""
    sizes: tuple[tuple[int, int], ...] = ((384, 240),)
    """Widths and heights of images, in pairs."""
    gaussians: tuple[int, ...] = (30_000,)
    """Numbers of Gaussians."""
    events: tuple[int, ...] = (10_000, 1_000_000)
    """Numbers of events in a batch."""
    rounds: int = 7
    """Timings of each candidate, of which the median counts; one of those that take over two seconds."""
    threads: int = 2
    """CPU threads of the kernels and of torch."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the kernels run; alternatives stay on the CPU."""
    scene: str = "office0"
    """Sequence of the suite slam."""
    duration: float = 1.0
    """Seconds of it."""
    out: Path | None = None
    """Folder that receives the results."""


def main(argv: Sequence[str] | None = None) -> None:
    """Time the kernels and what is built of them."""
    benchmark(read_options(BenchmarkOptions, argv, "edslam benchmark", __doc__))


def benchmark(options: BenchmarkOptions) -> None:
    """Time what the options ask for, print the table and write it to their folder."""
    load_kernels()
    import torch

    from edslam_ti import kernels
    from edslam_ti.experiments import kernel_times as timed
    from edslam_ti.experiments import steps

    try:
        kernels.init(options.device, threads=options.threads)
    except RuntimeError as error:  # no such device
        raise EdSlamError(str(error)) from error
    torch.set_num_threads(options.threads)
    watch = timed.Stopwatch(options.rounds)
    libraries = f"torch {torch.__version__}, kernels on {options.device}"
    machine = f"{timed.processor()}, {options.threads} threads, {libraries}"
    limits = f"{watch.bytes_per_second / 1e9:.3g} GB/s copied, {watch.flops_per_second / 1e9:.3g} GFLOP/s"
    lines = [f"{machine}; medians of {options.rounds}; {limits}", ""]
    lines += [HEADER] if set(options.suites) - {"scaling"} else []
    print("\n".join(lines))
    results = []
    sizes, gaussians, events = options.sizes, options.gaussians, options.events
    slam = options.scene, options.duration
    for row in steps.rows(options.suites, sizes, gaussians, events, slam, watch, options.device):
        results.append(row)
        lines.append(row.as_markdown())
        print(lines[-1], flush=True)
    curves: list[steps.Curve] = []
    if "scaling" in options.suites:
        alone = timed.Stopwatch(options.rounds, has_alternatives=False)
        curves += steps.scaling(sizes, gaussians, events, range(1, options.threads + 1), alone)
        table = steps.scaling_table(curves)
        lines += table
        print("\n".join(table))
    if options.out is not None:
        steps.write(options.out, machine, lines, results, curves)
