"""python apps/benchmark.py --suites rasterizer tracking

Time the kernels, and steps of a run, beside alternatives (torch, numpy, and numba and dv-processing where
installed) in turn in one process, and print a Markdown table; "limit" is the least time this machine could
take. What takes more than two seconds a call is timed once. --out FOLDER also writes benchmark.md and
benchmark.json there, and scaling.png for the suite `scaling`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from edslam_ti.cold_start import load_kernels
from edslam_ti.command_line import launch, parse_arguments
from edslam_ti.errors import EdSlamError

Suite = Literal["time_surface", "tracking", "rasterizer", "mapping_step", "cold_start", "slam", "scaling"]
KERNELS: tuple[Suite, ...] = ("time_surface", "tracking", "rasterizer", "mapping_step")
HEADER = (
    "| task | | wall ms | CPU ms | wall / first | CPU / first | limit ms |\n|---|---|--:|--:|--:|--:|--:|"
)


def benchmark(
    suites: tuple[Suite, ...] = KERNELS,
    sizes: tuple[tuple[int, int], ...] = ((384, 240),),
    gaussians: tuple[int, ...] = (30_000,),
    events: tuple[int, ...] = (10_000, 1_000_000),
    rounds: int = 7,
    threads: int = 2,
    device: Literal["cpu", "cuda"] = "cpu",
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
        scene: sequence of the suite slam
        duration: seconds of it
        out: folder that receives the results
    """
    load_kernels()
    import torch  # torch and Taichi take seconds to load

    from edslam_ti import kernels
    from edslam_ti.experiments import kernel_times as timed
    from edslam_ti.experiments import steps

    try:
        kernels.init(device, threads=threads)
    except RuntimeError as error:  # no such device
        raise EdSlamError(str(error)) from error
    torch.set_num_threads(threads)
    watch = timed.Stopwatch(rounds)
    machine = f"{timed.processor()}, {threads} threads, torch {torch.__version__}, kernels on {device}"
    limits = f"{watch.bytes_per_second / 1e9:.3g} GB/s copied, {watch.flops_per_second / 1e9:.3g} GFLOP/s"
    lines = [f"{machine}; medians of {rounds}; {limits}", ""]
    lines += [HEADER] if set(suites) - {"scaling"} else []
    print("\n".join(lines))
    results = []
    for row in steps.rows(suites, sizes, gaussians, events, (scene, duration), watch, device):
        results.append(row)
        lines.append(row.as_markdown())
        print(lines[-1], flush=True)
    curves: list[steps.Curve] = []
    if "scaling" in suites:
        alone = timed.Stopwatch(rounds, has_alternatives=False)
        curves += steps.scaling(sizes, gaussians, events, range(1, threads + 1), alone)
        table = steps.scaling_table(curves)
        lines += table
        print("\n".join(table))
    if out is not None:
        steps.write(out, machine, lines, results, curves)


def main(argv: Sequence[str] | None = None) -> None:
    parse_arguments(benchmark, argv, description=__doc__)


if __name__ == "__main__":
    launch(main)
