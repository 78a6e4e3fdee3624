"""One HTML page with everything: tables that sort, renders with a slider, paths, errors, stage times.

The page needs no network: numbers and pictures are in it. Its looks and its script are report.html.
"""

import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.experiments.jobs import Outcome
from edslam_ti.experiments.paper_tables import without_result
from edslam_ti.experiments.paper_views import ShownGroup, ShownRun
from edslam_ti.experiments.table_text import EMPTY, Table
from edslam_ti.output import atomic_file
from edslam_ti.results.pictures import as_data_uri

MOST_POINTS = 400  # of a path
TITLES = {
    "table1": "Table I: patch size",
    "table2": "Table II: number of patches",
    "table3": "Table III: novel views",
    "table4": "Table IV: trajectories",
    "runtime": "Runtime",
    "long": "Long paths",
}
STAGES = ("tracking", "mapping", "refinement", "saving")


def write_html(
    path: Path,
    tables: Sequence[Table],
    groups: Sequence[ShownGroup],
    outcomes: Sequence[Outcome],
    about: Sequence[str],
) -> None:
    """Write the page; `about` are lines that say what it is of."""
    methods = list(dict.fromkeys(run.method for group in groups for run in group.runs))
    content = {
        "about": list(about),
        "titles": TITLES,
        "methods": methods,
        "tables": [_table(table) for table in tables],
        "groups": [_group(group) for group in groups],
        "failures": without_result(outcomes),
    }
    text = json.dumps(content, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    template = files("edslam_ti.experiments").joinpath("report.html").read_text(encoding="utf-8")
    # Inside a script element only "</" could end it, and "<!--" would change how it is read.
    page = template.replace("__DATA__", text.replace("<", "\\u003c"))
    with atomic_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _table(table: Table) -> dict[str, Any]:
    rows = []
    for row in table.rows:
        cells = [(column, row.cells.get(column.key, EMPTY)) for column in table.columns]
        rows.append(
            {
                "labels": row.labels,
                "group": row.group,
                "cells": [
                    {"text": cell.text(column), "value": cell.value, "best": cell.is_best}
                    for column, cell in cells
                ],
            }
        )
    return {
        "name": table.name,
        "title": table.title.replace("`", ""),
        "labels": table.labels,
        "columns": [{"title": column.title, "group": column.group} for column in table.columns],
        "rows": rows,
        "notes": [note.replace("`", "") for note in table.notes],
    }


def _group(group: ShownGroup) -> dict[str, Any]:
    middle, axes = group.plane()

    def in_plane(positions: np.ndarray) -> list[list[float]]:
        return [[round(float(x), 4) for x in p] for p in (positions - middle) @ axes.T]

    truth = group.truth
    views = []
    for time in group.times():
        shown = [(run, view) for run in group.runs for view in run.views() if view.timestamp == time]
        true = next((view.panels()[0] for _, view in shown if view.psnr_db is not None), None)
        views.append(
            {
                "time": time,
                "truth": None if true is None else as_data_uri(true),
                "renders": [
                    {"method": run.method, "psnr": view.psnr_db, "image": as_data_uri(view.panels()[1])}
                    for run, view in shown
                ],
            }
        )
    return {
        "scene": group.scene,
        "data": group.data,
        "kind": group.kind,
        "truth": None if truth is None else in_plane(truth.poses[_thinned(len(truth)), :3, 3]),
        "runs": [_run(run, in_plane) for run in group.runs],
        "views": views,
    }


def _run(run: ShownRun, in_plane: Any) -> dict[str, Any]:
    positions, errors = run.aligned()
    chosen = _thinned(len(positions))
    metrics = run.outcome["metrics"]
    frames = metrics["num_frames"]
    seconds = metrics.get("seconds_per_frame", {})
    ate = metrics.get("ate_rmse_cm")
    stamps = run.trajectory.timestamps
    return {
        "method": run.method,
        "path": in_plane(positions[chosen]),
        "times": [round(float(t), 3) for t in stamps[chosen] - stamps[0]],
        "errors": [round(float(e), 4) if np.isfinite(e) else None for e in errors[chosen]],
        "ate": "-" if ate is None else f"{ate:.3f}",
        "lost": metrics["num_lost_frames"],
        "frames": frames,
        "stages": {stage: round(seconds.get(stage, 0.0) * frames, 3) for stage in STAGES},
    }


def _thinned(count: int) -> np.ndarray:  # [at most MOST_POINTS] indices
    return np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).round().astype(int))
