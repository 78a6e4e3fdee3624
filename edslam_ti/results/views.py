"""Views of the finished map, compared with the truth: held out, mapped and novel, each rendered once."""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.evaluation.images import (
    ImageMetrics,
    LinearFit,
    ViewMetrics,
    depth_l1_cm,
    evaluate_images,
)
from edslam_ti.evaluation.meshes import TrueSurfaces, seen_pixels, viewpoints
from edslam_ti.evaluation.trajectories import align_views
from edslam_ti.geometry import orthonormalized
from edslam_ti.mapping.mapper import Mapper
from edslam_ti.mapping.rendering import View
from edslam_ti.output import atomic_file
from edslam_ti.results.pictures import PictureRow, write_contact_sheet
from edslam_ti.results.run import Run
from edslam_ti.trajectory import Trajectory

KINDS = ("held out", "mapped", "novel")
CONTACT_ROWS = {"held out": 6, "mapped": 0, "novel": 6}  # of the contact sheet
PICTURES = {"held out": "{:06d}.png", "novel": "novel_{:06d}.png"}  # file names, by milliseconds


@dataclass(frozen=True)
class RenderedView:
    """The map at one pose, and the truth there."""

    timestamp: float  # seconds
    image: np.ndarray | None  # [H, W] truth
    depth: np.ndarray | None  # [H, W] metres, truth; of novel views 0 where the path never saw the surface
    view: View


@dataclass(frozen=True)
class ViewNumbers:
    """What was measured on all views of one kind together."""

    num_views: int
    images: ImageMetrics | None  # None: there are no views, or no true images
    depth_l1_cm: float | None  # over pixels with true depth where something is drawn
    images_in_slice: ImageMetrics | None  # of held-out views in IncEventGS's slice of the scene

    @property
    def fit(self) -> LinearFit | None:
        """EventNeRF's correction of brightness for these views."""
        return None if self.images is None else self.images.fit


def save_views(
    run: Run,
    truth: Trajectory | None,  # at the tracked times
    slice_s: tuple[float, float] | None,  # seconds, IncEventGS's slice
    folder: Path,
) -> dict[str, ViewNumbers]:
    """Render, draw and measure held-out, mapped and novel views; return the numbers of each kind.

    Write pictures, `contact.png` and `views.csv` into `folder`, nothing where there are no views.
    """
    weights = run.config.evaluation.lpips_weights
    numbers: dict[str, ViewNumbers] = {}
    rows: list[PictureRow] = []
    table: list[dict[str, Any]] = []
    for kind in KINDS:  # one kind at a time: their images take memory
        nothing: list[RenderedView] = []
        views = run.attempt(f"{kind} views", partial(_all_rendered, run, kind, truth), otherwise=nothing)
        measured = _image_metrics(run, views, weights)
        in_slice = None
        if slice_s is not None and kind == "held out":
            inside = [v for v in views if slice_s[0] <= v.timestamp <= slice_s[1]]
            in_slice = _image_metrics(run, inside, weights)
        numbers[kind] = ViewNumbers(len(views), measured, _depth_l1_cm(views), in_slice)
        chosen = evenly_spaced(len(views), CONTACT_ROWS[kind])
        of_views = iter([] if measured is None else measured.views)
        for k, view in enumerate(views):
            values = _values(view, None if view.image is None else next(of_views))
            table.append({"views": kind, "timestamp_s": f"{view.timestamp:.3f}", **values})
            row = _picture_row(kind, view, values, numbers[kind].fit)
            if kind in PICTURES:
                name = PICTURES[kind].format(round(1000 * view.timestamp))
                write_contact_sheet(folder / name, [row])
            if k in chosen:
                rows.append(row)
    if rows:
        write_contact_sheet(folder / "contact.png", rows, panel_width=256)
        _write_table(folder / "views.csv", table)
    return numbers


# --- rendering ---


def _all_rendered(run: Run, kind: str, truth: Trajectory | None) -> list[RenderedView]:
    return list(_rendered(run, kind, truth))


def _rendered(run: Run, kind: str, truth: Trajectory | None) -> Iterator[RenderedView]:
    """Render the views of a kind, at most `max_images` spread evenly, none without a map."""
    mapper, trajectory = run.slam.mapper, run.slam.trajectory
    if mapper is None:
        return
    most = run.config.evaluation.max_images
    if kind == "novel":
        yield from _novel_views(run, mapper, truth, most)
        return
    held_out = sorted(k for k in run.held_out if k < len(trajectory))
    indices = held_out
    if kind == "mapped":  # as many as were held out
        most = min(most, len(held_out))
        with_depth = np.flatnonzero(run.samples.has_depth[: len(trajectory)])
        indices = [int(k) for k in with_depth if k not in run.held_out]
    for k in (indices[j] for j in evenly_spaced(len(indices), most)):
        sample = run.samples.without_events(k)
        view = mapper.render(run.sequence.camera, trajectory.pose(k))
        yield RenderedView(sample.timestamp, sample.image, sample.depth, view)


def _novel_views(run: Run, mapper: Mapper, truth: Trajectory | None, most: int) -> Iterator[RenderedView]:
    """Render novel views: at true poses off the path, moved into the estimate's frame."""
    if truth is None:
        return
    trajectory, camera = run.slam.trajectory, run.sequence.camera
    start, end = trajectory.timestamps[[0, -1]]
    try:
        novel = [v for v in run.sequence.novel_views() if start <= v.timestamp <= end]
    except (DataError, OSError):
        return  # said before the first frame
    surfaces = run.sequence.surfaces_file
    seen_from = TrueSurfaces(surfaces).views(camera, viewpoints(truth)) if surfaces else None
    T_estimate_truth = np.linalg.inv(align_views(trajectory.resampled(truth.timestamps).poses, truth.poses))
    for true in (novel[k] for k in evenly_spaced(len(novel), most)):
        view = mapper.render(camera, orthonormalized(T_estimate_truth @ true.T_world_camera))
        depth = true.depth
        if seen_from is not None:
            depth = np.where(seen_pixels(camera, depth, true.T_world_camera, seen_from), depth, 0)
        yield RenderedView(true.timestamp, true.image, depth, view)


def evenly_spaced(count: int, most: int) -> list[int]:
    """Return at most `most` indices spread evenly over 0 .. count - 1."""
    return sorted({round(x) for x in np.linspace(0, count - 1, min(count, most))}) if count else []


# --- numbers ---


def _image_metrics(run: Run, views: list[RenderedView], lpips_weights: Path | None) -> ImageMetrics | None:
    """Return the metrics of the views that have an image; None if none has."""
    views = [v for v in views if v.image is not None]
    truths = [v.image for v in views if v.image is not None]
    if not views:
        return None
    masks = [None if v.depth is None else v.depth > 0 for v in views]
    images = [v.view.intensity for v in views]
    if lpips_weights is not None:
        try:
            return evaluate_images(images, truths, masks, lpips_weights)
        except (OSError, ValueError, RuntimeError) as error:  # of the file, or of torch when shapes differ
            run.leave_out("LPIPS", error)
    return evaluate_images(images, truths, masks)


def _depth_l1_cm(views: list[RenderedView]) -> float | None:
    """Return the depth error over pixels with true depth where something is drawn."""
    pairs = [(v.view.depth, v.depth) for v in views if v.depth is not None]
    drawn = [np.where(rendered > 0, true, 0) for rendered, true in pairs]
    return depth_l1_cm([rendered for rendered, _ in pairs], drawn) if pairs else None


def _values(view: RenderedView, measured: ViewMetrics | None) -> dict[str, float | None]:
    """Return the columns of views.csv for one view."""
    measured = measured or ViewMetrics(None, None, None)
    return {
        "psnr_corrected_db": measured.psnr_corrected_db,
        "ssim_corrected": measured.ssim_corrected,
        "lpips_corrected": measured.lpips_corrected,
        "depth_l1_cm": _depth_l1_cm([view]),
    }


def _write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    with atomic_file(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.4f}" if isinstance(v, float) else v for k, v in row.items()})


# --- pictures ---


def _picture_row(
    kind: str, view: RenderedView, values: dict[str, float | None], fit: LinearFit | None
) -> PictureRow:
    intensity = view.view.intensity if fit is None else fit(view.view.intensity)
    return PictureRow(_caption(kind, view, values), view.image, intensity, view.view.depth)


def _caption(kind: str, view: RenderedView, values: dict[str, float | None]) -> str:
    parts = [f"{kind}, t = {view.timestamp:.3f} s"]
    for name, text in (
        ("psnr_corrected_db", "PSNR {:.1f} dB corrected"),
        ("ssim_corrected", "SSIM {:.3f}"),
        ("lpips_corrected", "LPIPS {:.3f}"),
        ("depth_l1_cm", "depth L1 {:.2f} cm"),
    ):
        value = values[name]
        if value is not None:
            parts.append(text.format(value))
    return "    ".join(parts)
