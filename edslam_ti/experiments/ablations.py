"""Ablations of the tracker: change one setting at a time, as in the paper's Tables I and II and beyond."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from edslam_ti.config import Config, TrackingConfig
from edslam_ti.experiments.cases import Case, Recording
from edslam_ti.experiments.runs import Variant
from edslam_ti.methods import METHODS

NO_SURFACE = 1e4  # a standard deviation so large that time surfaces have no weight
SURFACES = {"brightness": False}  # time surfaces and depth, without brightness images

Changes = dict[str, Any]  # tracking settings, dots for nested ones, that differ from a method's own

# Changed setting -> method, and label of each row -> its changes.
TABLES: dict[str, tuple[str, dict[str, Changes]]] = {
    "Residuals": (
        "ed_slam",
        {
            "brightness images and depth": {},
            "brightness images alone": {"depth_weight": 0.0},
            "time surfaces and depth": SURFACES,
            "time surfaces alone": SURFACES | {"depth_weight": 0.0},
            "depth alone": SURFACES | {"surface_sigma": NO_SURFACE},
        },
    ),
    "Patch size (Table I), `ed_slam_paper`": (
        "ed_slam_paper",
        {f"{p} x {p}": {"patch_size": p} for p in (5, 7, 9, 11, 13)},
    ),
    "Number of patches (Table II), `ed_slam_paper`": (
        "ed_slam_paper",
        {f"{n}": {"num_patches": n} for n in (200, 400, 600, 800)},
    ),
    "Pixels aligned, `ed_slam`": (
        "ed_slam",
        {f"{n}": {"images.num_pixels": n} for n in (2500, 4050, 8100, 12_150, 16_200)},
    ),
    "Directions of Eq. 5, `ed_slam_paper`": (
        "ed_slam_paper",
        {"both": {}, "reference to new frame alone": {"directions": "forward"}},
    ),
    "Directions, time surfaces and depth": (
        "ed_slam",
        {"both": SURFACES, "reference to new frame alone": SURFACES | {"directions": "forward"}},
    ),
    "References, time surfaces and depth": (
        "ed_slam",
        {
            "previous frame": SURFACES | {"references": "previous"},
            "keyframe": SURFACES,
            "keyframe and previous frame": SURFACES | {"references": "both"},
        },
    ),
}


def ablation_rows() -> dict[str, dict[str, Variant]]:
    """Return the variant of every table and row; rows with the same settings share one."""
    return {
        title: {label: _variant(method, changes) for label, changes in rows.items()}
        for title, (method, rows) in TABLES.items()
    }


def ablation_variants() -> list[Variant]:
    """Return every variant once."""
    return list({v.name: v for rows in ablation_rows().values() for v in rows.values()}.values())


def ablation_cases(scenes: Sequence[str], seeds: Sequence[int]) -> list[Case]:
    """Return the recordings that all variants run on: Kinect-like depth at 20 Hz."""
    return [Case("ablation", Recording(scene, seed=seed), "kinect") for scene in scenes for seed in seeds]


def ablation_markdown(results: Sequence[dict[str, Any]]) -> str:
    """Return one table per setting: ATE rmse in cm on each case (mean over seeds), lost frames, speed."""
    rows = list(dict.fromkeys(r["row"] for r in results))
    lines = ["ATE rmse in cm, tracking alone; `default`: the method's own settings.", ""]
    for title, variants in ablation_rows().items():
        header = [title, *rows, "mean", "lost frames", "Hz"]
        lines += [f"| {' | '.join(header)} |", "| " + " | ".join(["---"] * len(header)) + " |"]
        for label, variant in variants.items():
            here = [r for r in results if r["variant"] == variant.name]
            good = [r for r in here if "ate_rmse_cm" in r]
            by_row = [[r["ate_rmse_cm"] for r in good if r["row"] == row] for row in rows]
            cells = [f"{np.mean(errors):.3f}" if errors else "-" for errors in by_row]
            if good:
                cells += [
                    f"{np.mean([r['ate_rmse_cm'] for r in good]):.3f}",
                    str(sum(r["num_lost_frames"] for r in good)),
                    f"{np.mean([r['tracking_hz'] for r in good]):.0f}",
                ]
            else:
                cells += ["-"] * 3
            name = f"{label} (default)" if variant.name == variant.method else label
            lines.append(f"| {' | '.join([name, *cells])} |")
        lines.append("")
    problems = list(dict.fromkeys(f"- {r['variant']}: {r['error']}" for r in results if "error" in r))
    return "\n".join(lines + problems)


def _variant(method: str, changes: Changes) -> Variant:
    own = Config(method=method).updated(dict(METHODS[method].overrides)).tracking
    differences = {name: value for name, value in changes.items() if _value(own, name) != value}
    name = "-".join([method, *(f"{key}_{value}" for key, value in differences.items())])
    settings: dict[str, Any] = {}
    for key, value in differences.items():
        *stages, last = key.split(".")
        inner = settings
        for stage in stages:
            inner = inner.setdefault(stage, {})
        inner[last] = value
    return Variant(name, method, {"mapping": {"enabled": False}, "tracking": settings})


def _value(settings: TrackingConfig, name: str) -> Any:
    """Return a (nested) setting."""
    return functools.reduce(getattr, name.split("."), settings)
