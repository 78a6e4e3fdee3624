"""The commands `edslam reproduce table1 ... table4`, `runtime` and `all`: runs, then tables and a report."""

import dataclasses
import json
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from rich.console import Console

from edslam_ti import __version__
from edslam_ti.config import read_differences
from edslam_ti.errors import ConfigError
from edslam_ti.experiments.html_report import write_html
from edslam_ti.experiments.jobs import Job, Outcome
from edslam_ti.experiments.paper_figures import write_figures
from edslam_ti.experiments.paper_options import PaperOptions
from edslam_ti.experiments.paper_plan import ALL, COMPARISONS, Wanted, plan
from edslam_ti.experiments.paper_store import store_tables
from edslam_ti.experiments.paper_tables import tables_of
from edslam_ti.experiments.paper_views import groups_of
from edslam_ti.experiments.published import PAPER_SCENES
from edslam_ti.experiments.scheduler import in_processes, on_ray, run_jobs
from edslam_ti.experiments.table_text import Table, as_latex, as_markdown
from edslam_ti.output import atomic_file


def reproduce_paper(names: Sequence[str], options: PaperOptions, console: Console | None = None) -> None:
    """Run what the tables of these names need, and write them; after Ctrl-C, those of the finished runs."""
    console = console or Console()
    wanted = wanted_by(options)
    jobs = plan(wanted, names)
    every = list(dict.fromkeys(job for table in names for job in jobs[table]))
    if not every:
        raise ConfigError(f"no recording passes the filters; see --scenes, --datasets and {options.data_dir}")
    executor = in_processes(options.jobs) if options.ray is None else on_ray(options.ray)
    finished: dict[str, Outcome] = {}
    try:
        for outcome in run_jobs(every, options.out, executor, console, options.fresh):
            finished[outcome["name"]] = outcome
    finally:
        if finished:
            written = write_all(names, jobs, finished, options)
            console.print(
                f"{len(finished)} of {len(every)} runs; " + ", ".join(map(str, written)), soft_wrap=True
            )


def wanted_by(options: PaperOptions) -> Wanted:
    """Return what the options choose."""
    differences = {} if options.config is None else read_differences(options.config)
    if options.lpips_weights is not None:
        differences.setdefault("evaluation", {})["lpips_weights"] = str(options.lpips_weights.resolve())
    same = {field.name for field in dataclasses.fields(Wanted)} - {"differences"}
    return Wanted(
        **{name: getattr(options, name) for name in same}, differences=json.dumps(differences, default=str)
    )


def write_all(
    names: Sequence[str], jobs: dict[str, list[Job]], finished: dict[str, Outcome], options: PaperOptions
) -> list[Path]:
    """Write each table as Markdown, LaTeX and JSON, the figures, and report.html; return what was written."""
    out, written = options.out, []
    tables: list[Table] = []
    compared: dict[str, Outcome] = {}
    for name in names:
        outcomes = [finished[job.name] for job in jobs[name] if job.name in finished]
        if not outcomes:
            continue
        if name in COMPARISONS:
            compared |= {o["name"]: o for o in outcomes}
        made = tables_of(name, outcomes, scenes_of(outcomes, options.scenes))
        tables += made
        for suffix, text in ((".md", as_markdown(made)), (".tex", as_latex(made))):
            _write(out / f"{name}{suffix}", text)
        written.append(out / f"{name}.md")
    everything = list(finished.values())
    _write(out / "results.json", json.dumps(everything, indent=1) + "\n")
    if options.store is not None:
        written += store_tables(options.store, tables, options)
    groups = groups_of(list(compared.values()), out)
    written += write_figures(groups, out)
    write_html(out / "report.html", tables, groups, everything, _about(everything))
    return [*written, out / "report.html"]


def scenes_of(outcomes: Sequence[Outcome], wanted: Sequence[str]) -> list[str]:
    """Return the scenes that get a column: the paper's, if all were asked for, and those that ran."""
    ran = list(dict.fromkeys(o["job"]["scene"] for o in outcomes))
    first = PAPER_SCENES if ALL in wanted else [s for s in PAPER_SCENES if s in ran]
    return [*first, *(scene for scene in ran if scene not in first)]


def _about(outcomes: Sequence[Outcome]) -> list[str]:
    good = [o for o in outcomes if "metrics" in o]
    seconds = sum(o["seconds"] for o in good)
    machines = ", ".join(dict.fromkeys(o["processor"] for o in good)) or "-"
    versions = ", ".join(dict.fromkeys(o["version"] for o in outcomes)) or __version__
    return [
        f"Written {datetime.now():%Y-%m-%d %H:%M} by edslam reproduce, version {versions}. "
        f"{len(good)} runs with a result, {len(outcomes) - len(good)} without, {seconds / 60:.0f} minutes of "
        f"running, on {machines}.",
        "Every row says what data it is from. The simulated rooms are stand-ins that have the names of "
        "EventReplica's scenes: published numbers (in italics, marked †) are of other recordings. Methods "
        "of others are written anew from their papers; they are not their authors' programs.",
    ]


def _write(path: Path, text: str) -> None:
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
