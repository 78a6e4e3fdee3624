"""The command `edslam benchmark`: times the suites on one or several engines, prints a table and writes it.

A process can load only one engine, so further engines run in child processes before the table is printed.
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from edslam_ti.cold_start import load_kernels
from edslam_ti.errors import EdSlamError

if TYPE_CHECKING:
    from edslam_ti.experiments.kernel_times import Row
    from edslam_ti.experiments.steps import Curve

Suite = Literal[
    "time_surface", "front_end", "tracking", "rasterizer", "mapping_step", "cold_start", "slam", "scaling"
]
Engine = Literal["taichi", "quadrants"]
KERNELS: tuple[Suite, ...] = ("time_surface", "tracking", "rasterizer", "mapping_step")
WHOLE_RUNS = ("cold_start", "slam")  # suites in which every row depends on the engine

CHILD = """
import json, sys
from edslam_ti.experiments.benchmark import benchmark
benchmark(**json.loads(sys.argv[1]))
"""


def benchmark(
    suites: Sequence[Suite] = KERNELS,
    sizes: Sequence[tuple[int, int]] = ((384, 240),),
    gaussians: Sequence[int] = (30_000,),
    events: Sequence[int] = (10_000, 1_000_000),
    rounds: int = 7,
    threads: int = 2,
    device: Literal["cpu", "cuda"] = "cpu",
    engines: Sequence[Engine] = (),  # none: that of EDSLAM_ENGINE
    scene: str = "office0",
    duration: float = 1.0,
    out: Path | str | None = None,
) -> None:
    """Time the kernels and the steps built on them; `edslam benchmark --help` explains the arguments.

    Raises EdSlamError when the engine or the device is missing.
    """
    _load_engine(engines[0] if engines else None)
    import torch  # torch and the engine take seconds to load

    from edslam_ti import kernels
    from edslam_ti.experiments import kernel_times as timed
    from edslam_ti.experiments import steps
    from edslam_ti.kernels.engine import ENGINE, VERSION

    try:
        kernels.init(device, threads=threads)
    except RuntimeError as error:  # no such device
        raise EdSlamError(str(error)) from error
    torch.set_num_threads(threads)
    settings = {
        "suites": suites, "sizes": sizes, "gaussians": gaussians, "events": events, "rounds": rounds,
        "threads": threads, "device": device, "scene": scene, "duration": duration,
    }  # fmt: skip
    others: dict[str, Any] = {engine: _in_child(engine, settings) for engine in engines if engine != ENGINE}
    watch = timed.Stopwatch(rounds)
    machine = (
        f"{timed.processor()}, {threads} threads, torch {torch.__version__}, "
        f"kernels on {device} by {ENGINE} {VERSION}"
    )
    limits = f"{watch.bytes_per_second / 1e9:.3g} GB/s copied, {watch.flops_per_second / 1e9:.3g} GFLOP/s"
    lines = [f"{machine}; medians of {rounds}; {limits}", ""]
    lines += header(list(others)) if set(suites) - {"scaling"} else []
    print("\n".join(lines))
    rows = []
    for row in steps.rows(suites, sizes, gaussians, events, (scene, duration), watch, device):
        rows.append(row)
        lines.append(row.as_markdown() + _columns(row, others))
        print(lines[-1], flush=True)
    curves: list[Curve] = []
    if "scaling" in suites:
        alone = timed.Stopwatch(rounds, has_alternatives=False)
        curves += steps.scaling(sizes, gaussians, events, range(1, threads + 1), alone)
        table = steps.scaling_table(curves)
        lines += table
        print("\n".join(table))
    if out is not None:
        _write(Path(out), machine, lines, rows, others, curves)


def _load_engine(name: Engine | None) -> None:
    """Load the kernels with the engine of that name."""
    if name is not None and "edslam_ti.kernels.engine" not in sys.modules:
        os.environ["EDSLAM_ENGINE"] = name
    load_kernels()
    from edslam_ti.kernels.engine import ENGINE

    if name not in (None, ENGINE):
        raise EdSlamError(f"engines: this process already runs {ENGINE}; name it first, or set EDSLAM_ENGINE")


def _in_child(engine: str, settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a benchmark that another engine runs, as in benchmark.json."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", CHILD, json.dumps({**settings, "out": folder})],
            env=os.environ | {"EDSLAM_ENGINE": engine}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise EdSlamError(f"{engine}: the benchmark failed: {reason.split('EdSlamError: ')[-1]}")
        rows: list[dict[str, Any]] = json.loads((Path(folder) / "benchmark.json").read_text())["rows"]
    return rows


def header(others: Sequence[str]) -> list[str]:
    """Return the first two lines of the table, with a column of wall times for each other engine."""
    line = "| task | | wall ms | CPU ms | wall / first | CPU / first | limit ms |"
    rule = "|---|---|--:|--:|--:|--:|--:|"
    return [line + "".join(f" {name} wall ms |" for name in others), rule + len(others) * "--:|"]


def _columns(row: "Row", others: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return the wall times of the other engines for the same task; empty if they did not run it."""
    from edslam_ti.experiments.kernel_times import OURS

    text = ""
    for engine, rows in others.items():
        name = row.name
        if row.suite not in WHOLE_RUNS:
            name = name.replace(OURS, engine.capitalize()) if name.startswith(OURS) else ""
        times = {(r["suite"], r["task"], r["name"]): r["wall_ms"] for r in rows}
        wall_ms = times.get((row.suite, row.task, name))
        text += "  |" if wall_ms is None else f" {wall_ms:.3g} |"
    return text


def _write(
    folder: Path,
    machine: str,
    lines: Sequence[str],
    rows: Sequence["Row"],
    others: Mapping[str, Sequence[Mapping[str, Any]]],
    curves: Sequence["Curve"],
) -> None:
    """Write benchmark.md and benchmark.json into the folder, and scaling.png if there are curves."""
    from edslam_ti.experiments.steps import plot_scaling
    from edslam_ti.output import atomic_file

    content = {
        "machine": machine,
        "rows": [dataclasses.asdict(row) for row in rows],
        "other_engines": others,
        "curves": [dataclasses.asdict(curve) | {"exponent": curve.exponent} for curve in curves],
    }
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_file(folder / "benchmark.md") as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    with atomic_file(folder / "benchmark.json") as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n")
    if curves:
        plot_scaling(folder / "scaling.png", curves)
