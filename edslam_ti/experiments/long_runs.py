"""The command `edslam reproduce long`: a minute and five in a flat of four rooms, and something that moves.

Ten and twenty times the path of the built-in rooms: drift, loop closure and memory show.
"""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from edslam_ti.config import read_differences
from edslam_ti.errors import ConfigError
from edslam_ti.experiments.html_report import write_html
from edslam_ti.experiments.jobs import EXACT, KINECT, Job, Outcome
from edslam_ti.experiments.paper_options import LongOptions
from edslam_ti.experiments.paper_tables import cell_of, several_programs, without_result
from edslam_ti.experiments.paper_views import ShownRun, groups_of
from edslam_ti.experiments.scheduler import in_processes, on_ray, run_jobs
from edslam_ti.experiments.table_text import LOW, Column, Row, Table, as_latex, as_markdown
from edslam_ti.geometry import inverse
from edslam_ti.methods import METHODS
from edslam_ti.output import atomic_file
from edslam_ti.results.plots import plot_drift
from edslam_ti.trajectory import read_tum

FLAT = "flat"
VISIBLE = 0.01  # cm; a path as first tracked that differs by less from the final one is not drawn


@dataclass(frozen=True)
class LongCase:
    """A walk through the flat."""

    duration: float  # seconds
    moving_object: bool = False


CASES = {"minute": LongCase(60.0), "five_minutes": LongCase(300.0), "moving": LongCase(60.0, True)}

# Drift by path: its file, and what it is called beside a method's name.
PATHS = {
    "drift_cm": ("trajectory_tum.txt", ""),
    "drift_first_cm": ("trajectory_frontend_tum.txt", " as first tracked"),
}

COLUMNS: tuple[tuple[Column, Callable[[Outcome], float | None]], ...] = (
    (Column("path", "path m", 1), lambda o: o["metrics"]["path_length_m"]),
    (Column("ate", "ATE cm", 2, LOW), lambda o: o["metrics"]["ate_rmse_cm"]),
    (Column("first", "ATE as first tracked cm", 2, LOW), lambda o: o["metrics"]["ate_frontend_rmse_cm"]),
    (Column("end", "drift at the end cm", 2, LOW), lambda o: o.get("drift_cm")),
    (Column("end_first", "as first tracked cm", 2, LOW), lambda o: o.get("drift_first_cm")),
    (Column("psnr", "PSNR dB", 1, -LOW), lambda o: o["metrics"]["psnr_corrected_db"]),
    (Column("lost", "lost frames", 0), lambda o: o["metrics"]["num_lost_frames"]),
    (Column("frames", "frames", 0), lambda o: o["metrics"]["num_frames"]),
    (Column("hz", "tracking Hz", 1), lambda o: o["metrics"]["tracking_hz"]),
    (Column("gaussians", "Gaussians, 1000", 1), lambda o: o["metrics"]["num_gaussians"] / 1000),
    (Column("memory", "peak memory MB", 0, LOW), lambda o: o["metrics"]["peak_memory_mb"]),
    (Column("total", "total s", 0, LOW), lambda o: o["metrics"]["wall_s"]),
)


def reproduce_long(options: LongOptions, console: Console | None = None) -> None:
    """Run the methods on the cases; write long.md, long.tex, drift-CASE.png and report.html."""
    console = console or Console()
    jobs = plan_long(options)
    executor = in_processes(options.jobs) if options.ray is None else on_ray(options.ray)
    finished: list[Outcome] = []
    try:
        finished.extend(run_jobs(jobs, options.out, executor, console, options.fresh))
    finally:
        if finished:
            write_long(finished, options.out)
            console.print(
                f"{len(finished)} of {len(jobs)} runs; {options.out / 'report.html'}", soft_wrap=True
            )


def plan_long(options: LongOptions) -> list[Job]:
    """Return the runs of the cases, those of one recording in a row.

    Raises ConfigError for an unknown case, method or kind of depth.
    """
    for what, values, known in (
        ("cases", options.cases, tuple(CASES)),
        ("methods", options.methods, tuple(METHODS)),
        ("depth", (options.depth,), (EXACT, KINECT)),
    ):
        unknown = [value for value in values if value not in known]
        if unknown:
            raise ConfigError(f"{what}: expected some of {', '.join(known)}, got '{unknown[0]}'")
    differences = {} if options.config is None else read_differences(options.config)
    return [
        Job(
            "builtin", FLAT, method, seed, options.depth,
            duration=CASES[case].duration if options.duration is None else options.duration,
            differences=json.dumps(differences, default=str, sort_keys=True), threads=options.threads,
            path="tour", moving_object=CASES[case].moving_object, size=(options.width, options.height),
        )
        for case in options.cases
        for seed in options.seeds
        for method in options.methods
    ]  # fmt: skip


def write_long(outcomes: Sequence[Outcome], out: Path) -> None:
    """Write the table, a picture of the drift along the path for each case, and the page."""
    groups = groups_of(outcomes, out)
    drifts: dict[str, dict[str, float]] = {}
    for group in groups:
        curves: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for run in group.runs:
            for key, (file, name) in PATHS.items():
                curve = drift_of(run, file)
                if curve is None:
                    continue
                drifts.setdefault(run.outcome["name"], {})[key] = float(curve[1][-1])
                final = curves.get(run.method)
                if final is None or np.abs(curve[1] - final[1]).max() > VISIBLE:
                    curves[run.method + name] = curve
        if curves:
            plot_drift(out / f"drift-{re.sub('[^0-9a-z]+', '-', group.kind.lower())}.png", curves)
    table = long_table([o | drifts.get(o["name"], {}) for o in outcomes])
    for suffix, text in ((".md", as_markdown([table])), (".tex", as_latex([table]))):
        with atomic_file(out / f"long{suffix}") as temporary:
            temporary.write_text(text, encoding="utf-8")
    about = ["Walks through a simulated flat of four rooms: drift, loop closure and memory on long paths."]
    write_html(out / "report.html", [table], groups, outcomes, about)


def drift_of(run: ShownRun, file: str) -> tuple[np.ndarray, np.ndarray] | None:  # [F] metres, [F] cm
    """Return the path walked, and the distance from the truth when both start at the same pose."""
    truth = run.truth
    if truth is None or not (run.folder / file).is_file():
        return None
    estimate = read_tum(run.folder / file)
    if len(estimate) != len(truth):  # the truth is written where it is known
        return None
    moved = truth.poses[0] @ inverse(estimate.poses[0]) @ estimate.poses
    steps = np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1)
    distance = 100 * np.linalg.norm(moved[:, :3, 3] - truth.poses[:, :3, 3], axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)]), distance


def long_table(outcomes: Sequence[Outcome]) -> Table:
    """Return a row for each case and method, mean and spread over seeds."""
    rows = []
    for data in dict.fromkeys(o["data"] for o in outcomes):
        here = [o for o in outcomes if o["data"] == data]
        for method in dict.fromkeys(o["job"]["method"] for o in here):
            runs = [o for o in here if o["job"]["method"] == method]
            rows.append(Row((data, method), {c.key: cell_of(runs, value) for c, value in COLUMNS}, data))
    columns = tuple(column for column, _ in COLUMNS)
    notes = (
        "drift: distance from the truth when both start at the same pose; the path ends where it began",
        "as first tracked: before loop closure and the map corrected earlier poses",
        *without_result(outcomes),
        *several_programs(outcomes),
    )
    return Table("long", "Long paths", ("data", "method"), columns, tuple(rows), notes).with_best()
