"""The results folder of a run: trajectory, map, pictures and numbers, written whole or not at all."""

import csv
import json
import os
import platform
import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from edslam_ti import __version__
from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, SampledSequence
from edslam_ti.depth_images import without_depth_edges
from edslam_ti.errors import DataError
from edslam_ti.evaluation.images import (
    ImageMetrics,
    LinearFit,
    ViewMetrics,
    align_views,
    ate_rmse_cm,
    depth_l1_cm,
    evaluate_images,
    inceventgs_slice,
    trajectory_errors,
)
from edslam_ti.evaluation.meshes import TrueSurfaces, lookouts, mesh_errors, seen_pixels
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.geometry import orthonormalized
from edslam_ti.mapping.gaussian_mapper import GaussianMapper
from edslam_ti.mapping.mapper import Mapper
from edslam_ti.mapping.rendering import View
from edslam_ti.output import atomic_file, atomic_folder
from edslam_ti.results.export import fuse_mesh, write_gaussian_ply, write_mesh, write_points
from edslam_ti.results.pictures import (
    NoEncoderError,
    PictureRow,
    fly_through_frames,
    smooth_path,
    write_contact_sheet,
    write_video,
)
from edslam_ti.results.plots import plot_trajectory
from edslam_ti.slam import Slam
from edslam_ti.trajectory import Trajectory, write_tum

MESH_VOXEL = 0.02  # metres
MESH_ALPHA = 0.5  # pixels less opaque, which have no median depth, are left out of the mesh
MESH_STEP, MESH_TURN = 0.1, 5.0  # metres, degrees between the views that are fused
CONTACT_ROWS = {"held out": 6, "mapped": 0, "novel": 6}  # of the contact sheet
VIDEO_FPS = 15.0


@dataclass
class Run:
    """What a run has produced so far; complete enough at any time to be saved."""

    config: Config
    sequence: EventDepthSequence
    samples: SampledSequence
    slam: Slam
    held_out: set[int]  # sample indices kept from mapping
    contrast: ContrastThreshold
    num_events: int = 0
    finish_seconds: float = 0.0
    is_interrupted: bool = False
    started: float = field(default_factory=time.perf_counter)
    messages: list[str] = field(default_factory=list)

    def note(self, message: str) -> None:
        """Add a line to the log, with the seconds since the start."""
        self.messages.append(f"{time.perf_counter() - self.started:8.2f} s  {message}")


def save(state: Run, console: Console) -> Path:
    """Write the results folder, whole or not at all, and point `latest` to it."""
    config, sequence = state.config, state.sequence
    parent = config.out / sequence.dataset / sequence.scene / config.method
    folder = _unused(parent / datetime.now().strftime("%Y-%m-%d_%H-%M-%S"))
    truth = _true_trajectory(state)
    started = time.perf_counter()
    with console.status("saving"), atomic_folder(folder) as partial:
        write_tum(state.slam.trajectory, partial / "trajectory_tum.txt")
        write_tum(state.slam.frontend_trajectory, partial / "trajectory_frontend_tum.txt")
        if truth is not None:
            write_tum(truth, partial / "truth_tum.txt")
        (partial / "config.yaml").write_text(config.to_yaml())
        mapper, mesh, fit = state.slam.mapper, None, None
        images, fit = _view_metrics(state, partial)
        if mapper is not None:
            if len(mapper.points()[0]):
                mesh = _write_map(state, mapper, partial)
                _write_fly_through(state, mapper, fit, partial / "flythrough.mp4")
            else:
                state.note("the map is empty: no map.ply, points.ply, mesh.ply, flythrough.mp4")
        metrics = _metrics(state, images | _mesh_metrics(state, mesh))
        plot_trajectory(partial / "trajectory.png", {config.method: state.slam.trajectory}, truth)
        metrics["seconds_per_frame"] = _stage_seconds(state, time.perf_counter() - started)
        metrics["wall_s"] = round(time.perf_counter() - state.started, 2)
        metrics["total_fps"] = round(metrics["num_frames"] / metrics["wall_s"], 3)
        metrics["peak_memory_mb"] = round(_peak_memory_mb(), 1)
        (partial / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
        state.note("seconds per frame: " + _listed(metrics["seconds_per_frame"]))
        state.note("saved")
        (partial / "log.txt").write_text("\n".join(state.messages) + "\n")
    _point_latest_to(folder)
    _print_summary(metrics, console)
    return folder


def _unused(folder: Path) -> Path:
    """Return the folder's name, numbered if two runs end in the same second."""
    candidate, k = folder, 2
    while candidate.exists():
        candidate, k = folder.with_name(f"{folder.name}-{k}"), k + 1
    return candidate


def _point_latest_to(folder: Path) -> None:
    link = folder.parent / "latest"
    temporary = folder.parent / f".latest.{os.getpid()}"
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(folder.name, target_is_directory=True)
    os.replace(temporary, link)


def _true_trajectory(state: Run) -> Trajectory | None:
    """Return the truth at the tracked times, where it is known."""
    truth = state.sequence.truth
    if truth is None:
        return None
    times = [t for t in state.slam.trajectory.timestamps if truth.covers(t)]
    return truth.resampled(np.array(times)) if times else None


def errors_of(state: Run) -> dict[str, float | None]:
    """Return the trajectory's errors by metric name; None without (enough) truth.

    `frontend`: of the poses as they were tracked, before the mapper corrected any.
    """
    names = (
        *("ate_rmse_cm", "ate_mean_cm", "ate_median_cm", "ate_max_cm", "ate_rmse_sim3_cm"),
        *("rpe_trans_cm", "rpe_rot_deg"),
    )
    truth = _true_trajectory(state)
    if truth is None or len(truth) < 3:
        return dict.fromkeys([*names, "ate_frontend_rmse_cm"])
    errors = trajectory_errors(state.slam.trajectory, truth)
    return {
        **{name: _rounded(getattr(errors, name)) for name in names},
        "ate_frontend_rmse_cm": _rounded(ate_rmse_cm(state.slam.frontend_trajectory, truth)),
    }


def _stage_seconds(state: Run, saving: float) -> dict[str, float]:
    """Return the seconds that each stage took, divided by the number of frames."""
    slam = state.slam
    stages = {
        "tracking": slam.tracking_seconds,
        "mapping": slam.mapping_seconds,
        "refinement": state.finish_seconds,
        "saving": saving,
    }
    return {name: round(seconds / len(slam.trajectory), 5) for name, seconds in stages.items()}


def _listed(values: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in values.items())


def _metrics(state: Run, of_map: dict[str, Any]) -> dict[str, Any]:
    """Return everything metrics.json says; `of_map` are the metrics of views and mesh."""
    config, sequence, slam = state.config, state.sequence, state.slam
    truth = _true_trajectory(state)
    frames = len(slam.trajectory)
    mapper = slam.mapper
    errors = errors_of(state)
    return {
        "dataset": sequence.dataset,
        "scene": sequence.scene,
        "description": sequence.description,
        "method": config.method,
        **errors,
        "path_length_m": _rounded(truth.length()) if truth is not None else None,
        **of_map,
        "num_frames": frames,
        "num_lost_frames": sum(not r.converged for r in slam.results),
        "num_keyframes": len(mapper.keyframes) if isinstance(mapper, GaussianMapper) else None,
        "num_gaussians": mapper.num_gaussians if mapper is not None else 0,
        "num_events": state.num_events,
        "num_mapping_steps": mapper.num_steps if isinstance(mapper, GaussianMapper) else None,
        "num_hot_pixels": int(mapper.images.noisy_pixels.sum())
        if isinstance(mapper, GaussianMapper)
        else None,
        "contrast_threshold": _rounded(state.contrast.value),
        "contrast_threshold_source": state.contrast.source,
        "contrast_threshold_positive": _rounded(state.contrast.positive),
        "contrast_threshold_negative": _rounded(state.contrast.negative),
        "contrast_threshold_deviation": _rounded(state.contrast.deviation),
        "tracking_hz": _rounded(frames / slam.tracking_seconds),
        "tracking_s": _rounded(slam.tracking_seconds),
        "mapping_s": _rounded(slam.mapping_seconds),
        "refinement_s": _rounded(state.finish_seconds),
        "device": f"{config.device} ({platform.machine()}, {config.threads} threads)",
        "version": __version__,
        "is_interrupted": state.is_interrupted,
        "protocol": (
            f"poses {config.poses}; ATE: SE(3)-aligned rmse over all frames (sim3: with scale), RPE over "
            f"consecutive frames; images: every {config.evaluation.hold_out_every}th depth frame held out "
            "from mapping, rendered at its estimated pose, over pixels with true depth (_all: every "
            "pixel), corrected by EventNeRF's linear fit in log space, one for each set of views; mapped: "
            "frames used for mapping; novel: true poses beside the path, moved into the estimate's frame, "
            "over pixels whose surface the path saw (_all: every pixel)"
        ),
        "protocols": _protocols(state, errors | of_map),
    }


# --- views ---


@dataclass(frozen=True)
class _RenderedView:
    """The map at one pose, and the truth there."""

    kind: str  # held out, mapped or novel
    timestamp: float  # seconds
    image: np.ndarray | None  # [H, W] truth
    depth: np.ndarray | None  # [H, W] metres, truth; of novel views 0 where the path never saw the surface
    view: View


# What metrics of a kind carry in their names; the headline's are plain.
SUFFIXES = {"held out": "", "mapped": "_mapped", "novel": "_novel"}


def _view_metrics(state: Run, folder: Path) -> tuple[dict[str, Any], LinearFit | None]:
    """Render views of all kinds, write pictures and a table, and return their metrics.

    The fit is that of the held-out views, None without true images.
    """
    metrics: dict[str, Any] = {}
    rows: list[PictureRow] = []
    table: list[dict[str, Any]] = []
    headline: LinearFit | None = None
    for kind, suffix in SUFFIXES.items():
        views = list(_rendered(state, kind))
        measured = _measured(views, state.config.evaluation.lpips_weights)
        metrics |= _named(views, measured, suffix)
        fit = None if measured is None else measured.fit
        if kind == "held out":
            headline = fit
        for k, shown in enumerate(views):
            numbers = _row_numbers(shown, None if measured is None else measured.views[k])
            name = f"{suffix.removeprefix('_')}{'_' if suffix else ''}{round(1000 * shown.timestamp):06d}.png"
            table.append({"views": kind, "timestamp_s": f"{shown.timestamp:.3f}", **numbers})
            row = PictureRow(
                _caption(shown, numbers),
                shown.image,
                shown.view.intensity if fit is None else fit(shown.view.intensity),
                shown.view.depth,
            )
            if kind != "mapped":
                write_contact_sheet(folder / "renders" / name, [row])
            if k in _evenly(len(views), CONTACT_ROWS[kind]):
                rows.append(row)
    if rows:
        write_contact_sheet(folder / "renders" / "contact.png", rows, panel_width=256)
        _write_table(folder / "renders" / "views.csv", table)
    return metrics, headline


def _rendered(state: Run, kind: str) -> Iterator[_RenderedView]:
    """Render the views of a kind, at most `max_images` spread evenly, none without a map."""
    slam, camera = state.slam, state.sequence.camera
    if slam.mapper is None:
        return
    most = state.config.evaluation.max_images
    if kind == "novel":
        yield from _novel_views(state, slam.mapper, most)
        return
    held_out = sorted(k for k in state.held_out if k < len(slam.trajectory))
    indices = held_out
    if kind == "mapped":  # as many as were held out
        most = min(most, len(held_out))
        seen = np.flatnonzero(state.samples.has_depth[: len(slam.trajectory)])
        indices = [int(k) for k in seen if k not in state.held_out]
    for k in (indices[j] for j in _evenly(len(indices), most)):
        sample = state.samples.without_events(k)
        view = slam.mapper.render(camera, slam.trajectory.pose(k))
        yield _RenderedView(kind, sample.timestamp, sample.image, sample.depth, view)


def _novel_views(state: Run, mapper: Mapper, most: int) -> Iterator[_RenderedView]:
    """Render at the true poses beside the path, moved into the estimate's frame."""
    trajectory, truth = state.slam.trajectory, _true_trajectory(state)
    if truth is None:
        return
    start, end = trajectory.timestamps[[0, -1]]
    novel = [v for v in state.sequence.novel_views() if start <= v.timestamp <= end]
    camera, surfaces = state.sequence.camera, state.sequence.surfaces_file
    looks = TrueSurfaces(surfaces).looks(camera, lookouts(truth)) if surfaces else None
    T_estimate_truth = np.linalg.inv(align_views(trajectory.resampled(truth.timestamps).poses, truth.poses))
    for true in (novel[k] for k in _evenly(len(novel), most)):
        view = mapper.render(camera, orthonormalized(T_estimate_truth @ true.T_world_camera))
        depth = true.depth
        if looks is not None:
            depth = np.where(seen_pixels(camera, depth, true.T_world_camera, looks), depth, 0)
        yield _RenderedView("novel", true.timestamp, true.image, depth, view)


def _measured(views: list[_RenderedView], lpips_weights: Path | None) -> ImageMetrics | None:
    truths = [v.image for v in views if v.image is not None]
    if not views or len(truths) < len(views):
        return None
    masks = [None if v.depth is None else v.depth > 0 for v in views]
    return evaluate_images([v.view.intensity for v in views], truths, masks, lpips_weights)


def _named(views: list[_RenderedView], measured: ImageMetrics | None, suffix: str) -> dict[str, Any]:
    """Return metrics under their names in metrics.json, None where there is nothing to measure."""
    kind = suffix or "_held_out"
    named: dict[str, Any] = {}
    for extent in ("", "_all"):
        for name in ("psnr{}_db", "psnr{}_corrected_db", "ssim{}_corrected", "lpips{}_corrected"):
            value = None if measured is None else getattr(measured, name.format("") + extent)
            named[name.format(suffix) + extent] = _rounded(value)
    for name in ("ssim{}_all", "lpips{}_all"):
        value = None if measured is None else getattr(measured, name.format(""))
        named[name.format(suffix)] = _rounded(value)
    named[f"depth_l1{suffix}_cm"] = _rounded(_depth_l1_cm(views))
    named[f"num{kind}_views"] = len(views)
    return named


def _depth_l1_cm(views: list[_RenderedView]) -> float | None:
    """Return the depth error over pixels with true depth where something is drawn."""
    pairs = [(v.view.depth, v.depth) for v in views if v.depth is not None]
    drawn = [np.where(rendered > 0, true, 0) for rendered, true in pairs]
    return depth_l1_cm([rendered for rendered, _ in pairs], drawn) if pairs else None


def _row_numbers(shown: _RenderedView, measured: ViewMetrics | None) -> dict[str, float | None]:
    depth_l1 = _depth_l1_cm([shown])
    if measured is None:
        measured = ViewMetrics(None, None, None)
    return {
        "psnr_corrected_db": measured.psnr_corrected_db,
        "ssim_corrected": measured.ssim_corrected,
        "lpips_corrected": measured.lpips_corrected,
        "depth_l1_cm": depth_l1,
    }


def _caption(shown: _RenderedView, numbers: dict[str, float | None]) -> str:
    parts = [f"{shown.kind}, t = {shown.timestamp:.3f} s"]
    for name, text in (
        ("psnr_corrected_db", "PSNR {:.1f} dB corrected"),
        ("ssim_corrected", "SSIM {:.3f}"),
        ("lpips_corrected", "LPIPS {:.3f}"),
        ("depth_l1_cm", "depth L1 {:.2f} cm"),
    ):
        value = numbers[name]
        if value is not None:
            parts.append(text.format(value))
    return "    ".join(parts)


def _write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    with atomic_file(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.4f}" if isinstance(v, float) else v for k, v in row.items()})


def _protocols(state: Run, metrics: dict[str, Any]) -> dict[str, Any]:
    """Return the results under the paper's protocol and under IncEventGS's."""
    truth, trajectory = _true_trajectory(state), state.slam.trajectory
    full = {
        "trajectory": "whole run, rmse after SE(3) alignment",
        "images": "held-out views, pixels with true depth, all after EventNeRF's fit",
        "ate_rmse_cm": metrics["ate_rmse_cm"],
        **{name: metrics[name] for name in ("psnr_corrected_db", "ssim_corrected", "lpips_corrected")},
    }
    slice_s = None
    if truth is not None and state.sequence.truth is not None and state.sequence.dataset == "event_replica":
        slice_s = inceventgs_slice(state.sequence.scene, state.sequence.truth, trajectory)
    ate = None
    if truth is not None:
        start, end = slice_s or (-np.inf, np.inf)
        inside = (trajectory.timestamps >= start) & (trajectory.timestamps <= end)
        part = Trajectory(trajectory.timestamps[inside], trajectory.poses[inside])
        ate = _rounded(ate_rmse_cm(part, truth, with_scale=True))
    if slice_s is None:
        names = {"psnr_corrected_db": "psnr_corrected_db_all", "ssim": "ssim_all", "lpips": "lpips_all"}
        images = {name: metrics[source] for name, source in names.items()}
    else:
        views = [v for v in _rendered(state, "held out") if slice_s[0] <= v.timestamp <= slice_s[1]]
        measured = _measured(views, state.config.evaluation.lpips_weights)
        images = {
            "psnr_corrected_db": _rounded(measured.psnr_corrected_db_all) if measured else None,
            "ssim": _rounded(measured.ssim_all) if measured else None,
            "lpips": _rounded(measured.lpips_all) if measured else None,
        }
    where = (
        f"their slice, {slice_s[0]:g} to {slice_s[1]:g} s" if slice_s else "whole run (no slice of theirs)"
    )
    inceventgs = {
        "trajectory": f"{where}, rmse after Sim(3) alignment",
        "images": "held-out views, all pixels; PSNR after EventNeRF's fit, SSIM and LPIPS before it",
        "ate_rmse_sim3_cm": ate,
        **images,
    }
    return {"full": full, "inceventgs": inceventgs}


# --- the map ---


def _write_map(state: Run, mapper: Mapper, folder: Path) -> Any | None:
    """Write map.ply (Gaussian maps), points.ply and mesh.ply; return the mesh, None where there is none."""
    points, brightness = mapper.points()
    write_points(folder / "points.ply", points, brightness)
    if isinstance(mapper, GaussianMapper):
        raw = {name: value.detach().numpy() for name, value in mapper.gaussians.raw.items()}
        write_gaussian_ply(
            folder / "map.ply",
            raw["means"],
            raw["quats"],
            raw["log_scales"],
            raw["logit_opacities"],
            mapper.gaussians.activated().colors.detach().numpy(),
        )

    def views() -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        for T in state.slam.trajectory.spread(MESH_STEP, MESH_TURN):
            view = mapper.render(state.sequence.camera, T, measured_only=True)
            opaque = np.where(view.alpha > MESH_ALPHA, view.depth, 0)
            yield without_depth_edges(opaque), view.intensity, T

    try:
        mesh = fuse_mesh(views(), state.sequence.camera, MESH_VOXEL)
        write_mesh(folder / "mesh.ply", mesh)
    except DataError as error:  # a map too thin for a surface: the other results stand
        state.note(str(error))
        return None
    return mesh


def _mesh_metrics(state: Run, mesh: Any | None) -> dict[str, float | None]:
    """Return the mesh's errors against the true surfaces that the camera saw; None without them."""
    names = ("mesh_accuracy_cm", "mesh_completion_cm", "mesh_completion_ratio_5cm")
    sequence = state.sequence
    if mesh is None or sequence.surfaces_file is None or _true_trajectory(state) is None:
        return dict.fromkeys(names)
    errors = mesh_errors(mesh, sequence, state.slam.trajectory)
    values = (errors.accuracy_cm, errors.completion_cm, errors.completion_ratio)
    return {name: _rounded(value) for name, value in zip(names, values)}


def _write_fly_through(state: Run, mapper: Mapper, fit: LinearFit | None, path: Path) -> None:
    """Write a video of the map along the smoothed path, brightness corrected where the truth is known."""

    def views() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for T in smooth_path(state.slam.trajectory, VIDEO_FPS, state.config.evaluation.flythrough_frames):
            view = mapper.render(state.sequence.camera, T)
            yield view.intensity if fit is None else fit(view.intensity), view.depth

    try:
        write_video(path, fly_through_frames(views()), VIDEO_FPS)
    except NoEncoderError as error:  # the other results stand
        state.note(str(error))


def _evenly(count: int, most: int) -> list[int]:
    """Return at most `most` indices spread evenly over 0 .. count - 1."""
    return sorted({round(x) for x in np.linspace(0, count - 1, min(count, most))}) if count else []


def _rounded(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else round(float(value), 4)


def _peak_memory_mb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def _print_summary(metrics: dict[str, Any], console: Console) -> None:
    def show(name: str, unit: str) -> str:
        value = metrics.get(name)
        return "-" if value is None else f"{value:.2f} {unit}"

    console.print(
        f"ATE {show('ate_rmse_cm', 'cm')}  RPE {show('rpe_trans_cm', 'cm')}, {show('rpe_rot_deg', 'deg')}  "
        f"PSNR {show('psnr_corrected_db', 'dB')} corrected, {show('psnr_db', 'dB')} raw  "
        f"depth L1 {show('depth_l1_cm', 'cm')}\n"
        f"{metrics['num_frames']} frames, {metrics['num_lost_frames']} lost, "
        f"{metrics['num_gaussians']} Gaussians, tracking {show('tracking_hz', 'Hz')}, "
        f"{metrics['wall_s']:.0f} s in all, {metrics['peak_memory_mb']:.0f} MB"
    )
