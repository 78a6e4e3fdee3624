"""Ablations of the tracker: one setting changed at a time, as the paper's Tables I and II and beyond."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from edslam_ti.config import TrackingConfig
from edslam_ti.reproduce.cases import Case, Recording
from edslam_ti.reproduce.runs import Variant

DEFAULT = Variant("ed_slam", "ed_slam", {"mapping": {"enabled": False}})
NO_SURFACE = 1e4  # a standard deviation so large that time surfaces count for nothing

# What is changed -> label of a row -> tracking settings; {} is the default.
SETTINGS: dict[str, dict[str, dict[str, Any]]] = {
    "Patch size (Table I of the paper)": {f"{p} x {p}": {"patch_size": p} for p in (5, 7, 9, 11, 13)},
    "Number of patches (Table II of the paper)": {
        f"{n}": {"num_patches": n} for n in (100, 200, 400, 600, 800)
    },
    "Directions of Eq. 5": {
        "both": {"directions": "both"},
        "reference to new frame alone": {"directions": "forward"},
    },
    "Residuals": {
        "time surface and depth": {},
        "time surface alone": {"depth_weight": 0.0},
        "depth alone": {"surface_sigma": NO_SURFACE},
    },
    "References": {
        "previous frame (paper)": {"references": "previous"},
        "keyframe": {"references": "keyframe"},
        "both": {"references": "both"},
    },
}


def ablation_rows() -> dict[str, dict[str, Variant]]:
    """Return the variant of every table and row; rows at the defaults share one."""
    return {
        title: {label: _variant(changed) for label, changed in rows.items()}
        for title, rows in SETTINGS.items()
    }


def ablation_variants() -> list[Variant]:
    """Return every variant once, the default first."""
    variants = {v.name: v for rows in ablation_rows().values() for v in rows.values()}
    return [DEFAULT, *(v for name, v in variants.items() if name != DEFAULT.name)]


def ablation_cases(scenes: Sequence[str], seeds: Sequence[int]) -> list[Case]:
    """Return the recordings that all variants run on: Kinect-like depth at 20 Hz."""
    return [Case("ablation", Recording(scene, seed=seed), "kinect") for scene in scenes for seed in seeds]


def ablation_markdown(results: Sequence[dict[str, Any]]) -> str:
    """Return one table per setting: ATE rmse in cm on each case (mean over seeds), lost frames, speed."""
    rows = list(dict.fromkeys(r["row"] for r in results))
    lines = ["ATE rmse in cm, tracking alone; `default` marks the setting that `ed_slam` has.", ""]
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
            name = f"{label} (default)" if variant.name == DEFAULT.name else label
            lines.append(f"| {' | '.join([name, *cells])} |")
        lines.append("")
    problems = list(dict.fromkeys(f"- {r['variant']}: {r['error']}" for r in results if "error" in r))
    return "\n".join(lines + problems)


def _variant(changed: dict[str, Any]) -> Variant:
    defaults = TrackingConfig()
    differences = {name: value for name, value in changed.items() if getattr(defaults, name) != value}
    if not differences:
        return DEFAULT
    name = "-".join(f"{key}_{value}" for key, value in differences.items())
    return Variant(name, DEFAULT.method, DEFAULT.differences | {"tracking": differences})
