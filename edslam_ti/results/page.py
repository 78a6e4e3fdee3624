"""index.html of a results folder: what ran, the numbers that matter, pictures, and how to go on.

The page has no script and names no address: pictures are in it or beside it, so it needs no network.
"""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import cv2
import numpy as np

from edslam_ti import __version__
from edslam_ti.errors import plain
from edslam_ti.output import atomic_file
from edslam_ti.results.pictures import as_data_uri

PAGE = "index.html"
WIDEST = 1240  # pixels of a picture inside the page; it links to the whole one
LONGEST_NAME = 200  # characters of a name from a recording
FILES = {  # what is said of a file, in the order of the page
    "trajectory_tum.txt": "the path: t tx ty tz qx qy qz qw, seconds and metres, camera to world",
    "truth_tum.txt": "the true path at the same times",
    "poses.csv": "every pose with its standard deviations, whether it was lost, and why",
    "map.ply": "the Gaussians, in the layout of 3D Gaussian splatting",
    "mesh.ply": "the surface, with colours at its vertices",
    "points.ply": "the centres of the Gaussians",
    "flythrough.mp4": "render and depth along the smoothed path",
    "renders/views.csv": "the numbers of every rendered view",
    "metrics.json": "every number, with its unit in its name",
    "camera.json": "the camera: size and pinhole intrinsics in pixels, centres at integers",
    "config.yaml": "all settings",
    "log.txt": "lost frames and other events",
}


@dataclass(frozen=True)
class Scale:
    """From which value on a number is good, and from which it is at least fair."""

    good: float
    fair: float  # larger than `good`: small values are better

    def word(self, value: float) -> str:
        """Return good, fair or poor."""
        sign = 1 if self.fair > self.good else -1
        if sign * value <= sign * self.good:
            return "good"
        return "fair" if sign * value <= sign * self.fair else "poor"


@dataclass(frozen=True)
class Row:
    """A number on the page."""

    name: str
    text: str
    word: str  # good, fair, poor or empty
    meaning: str


MAP_NUMBERS: dict[str, tuple[str, str, Scale, str]] = {  # by key of metrics.json
    "psnr_corrected_db": ("render: PSNR", "{:.1f} dB", Scale(30, 24), "good: above 30 dB, fair: above 24"),
    "ssim_corrected": ("render: SSIM", "{:.3f}", Scale(0.9, 0.75), "structure kept; good: above 0.9"),
    "lpips_corrected": ("render: LPIPS", "{:.3f}", Scale(0.15, 0.35), "seen difference; good: below 0.15"),
    "depth_l1_cm": ("render: depth error", "{:.2f} cm", Scale(1, 5), "mean; good: below 1 cm, fair: below 5"),
    "mesh_accuracy_cm": ("mesh: distance to truth", "{:.2f} cm", Scale(1, 3), "mean; good: below 1 cm"),
    "mesh_completion_ratio_5cm": (
        *("mesh: share of truth", "{:.1%}", Scale(0.9, 0.7)),
        "of the true surface that was seen, within 5 cm; good: above 90 %",
    ),
}


def write_page(
    folder: Path,
    metrics: dict[str, Any],  # of metrics.json
    duration_s: float,  # seconds of the recording
    left_out: Sequence[str],  # a line for each part of the results that is missing
) -> None:
    """Write index.html into a results folder; it shows what other files are there."""
    title = f"{_name(metrics['scene'])}: {_name(metrics['method'])}"
    lines = [*metrics["problems"], *metrics["data_notes"], *metrics["truth_notes"], *left_out]
    if metrics["is_interrupted"]:
        lines.insert(0, "the run was interrupted; this is what there was until then")
    contact = _picture(folder, "renders/contact.png", "truth, render, error and depth of views")
    text = Template(files("edslam_ti.results").joinpath("page.html").read_text(encoding="utf-8")).substitute(
        title=escape(title),
        about="\n".join(f"<p>{escape(line)}</p>" for line in _about(metrics, duration_s)),
        warnings=_warnings(lines),
        numbers="\n".join(map(_table_row, number_rows(metrics, duration_s))),
        panels=_panels(folder),
        contact=contact and f"<h2>Views that mapping did not see</h2>\n{contact}",
        commands=escape("\n".join(_commands(folder, metrics))),
        files="\n".join(_file_rows(folder)),
        footer=escape(f"ED-SLAM in Taichi {__version__}"),
    )
    with atomic_file(folder / PAGE) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def _name(value: object) -> str:
    return plain(value, LONGEST_NAME)


# --- what ran ---


def _about(metrics: dict[str, Any], duration_s: float) -> list[str]:
    return [
        plain(metrics["description"], 2 * LONGEST_NAME),
        f"{metrics['num_frames']} frames, {duration_s:.2f} s, {metrics['num_events']:,} events; "
        f"{metrics['device']}; {metrics['wall_s']:.0f} s in all, {metrics['peak_memory_mb']:.0f} MB",
    ]


def _warnings(lines: Sequence[str]) -> str:
    if not lines:
        return ""
    items = "\n".join(f"<li>{escape(plain(line, 1000))}</li>" for line in lines)
    return f'<h2>Warnings</h2>\n<ul class="warnings">\n{items}\n</ul>'


def _commands(folder: Path, metrics: dict[str, Any]) -> list[str]:
    where = shlex.quote(plain(folder, 4096))
    lines = [f"edslam slam --resume {where}"] if metrics["is_interrupted"] else []
    lines += [f"edslam view {where} --viewer", f"edslam view {where} --save picture.png"]
    lines += [f"edslam export {where}"] if (folder / "map.ply").is_file() else []
    return [*lines, f"edslam slam --config {shlex.quote(plain(folder / 'config.yaml', 4096))} --seed 1"]


# --- numbers ---


def number_rows(metrics: dict[str, Any], duration_s: float) -> list[Row]:
    """Return the numbers that matter, each with a word on how good it is and what good means."""
    rows = [*_path_rows(metrics), *_map_rows(metrics)]
    rate, frames_hz = metrics["tracking_hz"], (metrics["num_frames"] - 1) / max(duration_s, 1e-9)
    if rate is not None:
        meaning = f"good: as fast as the frames come, {frames_hz:.0f} Hz; without mapping"
        word = Scale(frames_hz, frames_hz / 4).word(rate)
        rows.append(Row("tracking speed", f"{rate:.1f} Hz", word, meaning))
    speed = "frames a second in all, with mapping, refinement and these pictures"
    return [*rows, Row("whole run", f"{metrics['total_fps']:.2f} Hz", "", speed)]


def _path_rows(metrics: dict[str, Any]) -> list[Row]:
    rows: list[Row] = []

    def add(key: str, name: str, form: str, scale: Scale, meaning: str) -> None:
        if metrics[key] is not None:
            rows.append(Row(name, form.format(metrics[key]), scale.word(metrics[key]), meaning))

    share = metrics["num_lost_frames"] / max(metrics["num_frames"], 1)
    lost = f"{metrics['num_lost_frames']} of {metrics['num_frames']}"
    meaning = "good: none; poor: more than a tenth, then the path cannot be relied on"
    rows.append(Row("lost frames", lost, Scale(0, 0.1).word(share), meaning))
    length = metrics["path_length_m"]
    if metrics["ate_rmse_cm"] is None or not length:
        meaning = "no true path is known, so its error cannot be measured; see the standard deviation"
        rows.append(Row("error of the path (ATE)", "-", "", meaning))
    else:
        meaning = f"rmse after alignment; good: below 0.5 % of the path's {length:.2f} m, fair: below 2 %"
        add("ate_rmse_cm", "error of the path (ATE)", "{:.3f} cm", Scale(0.5 * length, 2.0 * length), meaning)
        compared = f"{metrics['num_truth_poses_compared']} poses"
        meaning = "poses with known truth; good: all"
        share = metrics["truth_coverage"] or 0.0
        rows.append(Row("compared with truth", compared, Scale(0.99, 0.5).word(share), meaning))
        if metrics["ate_scale_sim3"] is not None:
            scale, meaning = metrics["ate_scale_sim3"], "true size over estimated size; good: within 1 % of 1"
            word = Scale(0.01, 0.03).word(abs(scale - 1))
            rows.append(Row("scale (Sim(3))", f"{scale:.4f}", word, meaning))
    meaning = "what the tracker itself says of its last pose, without any truth; good: below 1 cm"
    name = "standard deviation at the end"
    add("sigma_position_end_cm", name, "{:.2f} cm", Scale(1, 5), meaning)
    return rows


def _map_rows(metrics: dict[str, Any]) -> list[Row]:
    rows = [
        Row(name, form.format(metrics[key]), scale.word(metrics[key]), meaning)
        for key, (name, form, scale, meaning) in MAP_NUMBERS.items()
        if metrics[key] is not None
    ]
    if metrics["num_gaussians"]:
        meaning = "size of the map; it grows with the surface that was seen"
        rows.append(Row("Gaussians", f"{metrics['num_gaussians']:,}", "", meaning))
    return rows


def _table_row(row: Row) -> str:
    word = f'<span class="{row.word}"></span>' if row.word else ""
    cells = "</td><td>".join((escape(row.name), escape(row.text), word, escape(row.meaning)))
    return f"<tr><td>{cells}</td></tr>"


# --- pictures and files ---


def _panels(folder: Path) -> str:
    panels = []
    if path := _picture(folder, "trajectory.png", "the path from the top and from the side"):
        panels.append(f"<div><h2>Path</h2>\n{path}</div>")
    if (folder / "flythrough.mp4").is_file():
        video = '<video controls muted loop preload="metadata" src="flythrough.mp4#t=0.1"></video>'
        panels.append(f"<div><h2>Fly-through: render and depth</h2>\n{video}</div>")
    return "\n".join(panels)


def _picture(folder: Path, name: str, what: str) -> str:
    """Return a picture, reduced, inside a link to its file; empty where it is missing or unreadable."""
    picture = cv2.imread(str(folder / name)) if (folder / name).is_file() else None
    if picture is None:
        return ""
    height, width = picture.shape[:2]
    if width > WIDEST:
        size = (WIDEST, round(height * WIDEST / width))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    uri = as_data_uri(np.asarray(picture)[..., ::-1])
    return f'<a href="{name}"><img src="{uri}" alt="{what}"></a>'


def _file_rows(folder: Path) -> list[str]:
    return [
        f'<tr><td><a href="{name}">{name}</a></td><td>{_size(folder / name)}</td><td>{what}</td></tr>'
        for name, what in FILES.items()
        if (folder / name).is_file()
    ]


def _size(path: Path) -> str:
    size = path.stat().st_size
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{max(size / 1e3, 0.1):.1f} kB"
