"""edslam benchmark --suites rasterizer tracking

Time the kernels, and steps of a run, against alternatives (torch, numpy, and numba and dv-processing if
installed) in turn in one process, and print a Markdown table; "limit" is the least time this machine could
take. Calls of more than two seconds are timed once. --out FOLDER also writes benchmark.md and
benchmark.json there, and scaling.png for the suite `scaling`.

    edslam benchmark --engines taichi quadrants           both engines of the kernels, a column each
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from edslam_ti.arguments import read_options
from edslam_ti.config import Stage
from edslam_ti.experiments.benchmark import KERNELS, Engine, Suite, benchmark


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
    engines: tuple[Engine, ...] = ()
    """Engines of the kernels, the first in this process; none: the one of EDSLAM_ENGINE, or taichi."""
    scene: str = "office0"
    """Sequence of the suite slam."""
    duration: float = 1.0
    """Seconds of it."""
    out: Path | None = None
    """Folder that receives the results."""


def main(argv: Sequence[str] | None = None) -> None:
    """Time the kernels and what is built of them."""
    options = read_options(BenchmarkOptions, argv, "edslam benchmark", __doc__)
    benchmark(**dict(options))
