"""Writes results as one JSON file, Markdown tables and pictures."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.output import atomic_file
from edslam_ti.results.plots import plot_drift, plot_groups

Result = dict[str, Any]


def write_report(results: Sequence[Result], out: Path, title: str) -> Path:
    """Write results.json, tracking.md, ate.png and (if a long case ran) drift.png; return the table."""
    out.mkdir(parents=True, exist_ok=True)
    with atomic_file(out / "results.json") as temporary:
        temporary.write_text(json.dumps(list(results), indent=1) + "\n")
    table = out / "tracking.md"
    with atomic_file(table) as temporary:
        temporary.write_text(markdown(results, title))
    good = [r for r in results if "ate_rmse_cm" in r]
    if good:
        by_group = {
            group: {
                v: [r["ate_rmse_cm"] for r in good if (r["variant"], r["group"]) == (v, group)]
                for v in _variants(good)
            }
            for group in _unique(r["group"] for r in good)
        }
        plot_groups(out / "ate.png", by_group, "ATE rmse [cm]")
    long = [r for r in good if r["group"] == "long"]
    if long:
        curves = {
            f"{r['case']} {r['variant']}": (np.array(r["curve"]["path_m"]), np.array(r["curve"]["drift_cm"]))
            for r in long
        }
        plot_drift(out / "drift.png", curves)
    return table


def markdown(results: Sequence[Result], title: str) -> str:
    """Return the tables: one row per group and depth, then one row per case; mean / worst over the seeds."""
    variants = _variants(results)
    lines = [
        f"# {title}",
        "",
        "ATE rmse in cm over all frames (SE(3)), mean / worst over seeds; `lost`: frames.",
        "",
    ]
    lines += ["## By group", "", *_table(results, variants, _group_row), ""]
    lines += ["## By case", "", *_table(results, variants, lambda r: r["row"]), ""]
    lines += ["## All measures", "", *_measures(results), ""]
    problems = _unique(
        f"- {r['row']}, {r['variant']}: {name}: {r[name]}"
        for r in results
        for name in ("error", "skipped")
        if name in r
    )
    if problems:
        lines += ["## Without a result", "", *problems, ""]
    return "\n".join(lines)


def insert_into(document: Path, name: str, text: str) -> None:
    """Replace the text between `<!-- NAME -->` and `<!-- end NAME -->` in a Markdown document."""
    new = inserted(document.read_text(), name, text, document)
    with atomic_file(document) as temporary:
        temporary.write_text(new)


def inserted(old: str, name: str, text: str, document: Path) -> str:
    """Return the text `old` of a document with `text` between the marks of that name."""
    begin, end = f"<!-- {name} -->\n", f"<!-- end {name} -->"
    if old.count(begin) != 1 or old.count(end) != 1 or old.index(begin) > old.index(end):
        raise DataError(f"{document}: expected the lines '{begin.strip()}' and '{end}' once each; add them")
    return old[: old.index(begin) + len(begin)] + text.rstrip("\n") + "\n" + old[old.index(end) :]


def _group_row(result: Result) -> str:
    """Return the row's name without its scene."""
    return " ".join([result["group"], *result["row"].split("-")[1:]])


def _table(results: Sequence[Result], variants: list[str], row_of: Callable[[Result], str]) -> list[str]:
    header = ["case", "runs", *(f"`{v}`" for v in variants)]
    lines = [_line(header), _line(["---"] * len(header))]
    for row in _unique(row_of(r) for r in results):
        here = [r for r in results if row_of(r) == row]
        cells = [_cell([r for r in here if r["variant"] == v]) for v in variants]
        runs = max(len([r for r in here if r["variant"] == v]) for v in variants)
        lines.append(_line([row, str(runs), *cells]))
    return lines


def _cell(results: Sequence[Result]) -> str:
    """Return mean / worst ATE, and the numbers of lost frames and of runs without result if there are any."""
    errors = [r["ate_rmse_cm"] for r in results if "ate_rmse_cm" in r]
    if not errors:
        return "-"
    text = f"{np.mean(errors):.2f} / {max(errors):.2f}"
    lost = sum(r.get("num_lost_frames", 0) for r in results)
    missing = len(results) - len(errors)
    return text + (f", {lost} lost" if lost else "") + (f", {missing} without result" if missing else "")


def _measures(results: Sequence[Result]) -> list[str]:
    """Return every measure of every row and variant, mean over the seeds."""
    names = {
        "ate_rmse_cm": "ATE cm",
        "ate_max_cm": "max cm",
        "ate_at_depth_rmse_cm": "ATE at depth frames cm",
        "ate_frontend_rmse_cm": "ATE as first tracked cm",
        "rpe_trans_cm": "RPE cm",
        "rpe_rot_deg": "RPE deg",
        "final_drift_cm": "drift at the end cm",
        "path_m": "path m",
        "num_lost_frames": "lost",
        "num_frames": "frames",
        "tracking_hz": "Hz",
    }
    lines = [_line(["case", "method", *names.values()]), _line(["---"] * (2 + len(names)))]
    for row in _unique(r["row"] for r in results):
        for variant in _variants(results):
            here = [r for r in results if (r["row"], r["variant"]) == (row, variant) and "ate_rmse_cm" in r]
            if here:
                values = [f"{np.mean([r[name] for r in here]):.3g}" for name in names]
                lines.append(_line([row, f"`{variant}`", *values]))
    return lines


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _variants(results: Sequence[Result]) -> list[str]:
    return _unique(r["variant"] for r in results)


def _unique(values: Any) -> list[Any]:
    return list(dict.fromkeys(values))
