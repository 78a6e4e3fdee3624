"""The results folder of a run: trajectory, map, pictures and numbers, written whole or not at all."""

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
from edslam_ti.errors import DataError
from edslam_ti.evaluation import depth_l1_cm, evaluate_images, fit_event_nerf, psnr, trajectory_errors
from edslam_ti.export import fuse_mesh, write_gaussian_ply, write_mesh, write_points
from edslam_ti.mapping import GaussianMapper, Mapper
from edslam_ti.output import atomic_folder
from edslam_ti.rendering import View
from edslam_ti.slam import Slam
from edslam_ti.trajectory import Trajectory, write_tum
from edslam_ti.visualization import plot_trajectory, write_render_triptychs

MESH_VIEWS = 40  # rendered depth images fused into the mesh
MESH_VOXEL = 0.02  # metres


@dataclass
class Run:
    """What a run has produced so far; complete enough at any time to be saved."""

    config: Config
    sequence: EventDepthSequence
    samples: SampledSequence
    slam: Slam
    held_out: set[int]  # sample indices kept from mapping
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
        metrics = _metrics(state, partial)
        if state.slam.mapper is not None:
            _write_map(state, state.slam.mapper, partial)
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
    frontend = trajectory_errors(state.slam.frontend_trajectory, truth)
    return {
        **{name: _rounded(getattr(errors, name)) for name in names},
        "ate_frontend_rmse_cm": _rounded(frontend.ate_rmse_cm),
    }


def _stage_seconds(state: Run, saving: float) -> dict[str, float]:
    """Return the seconds that each stage took, divided by the number of frames."""
    slam = state.slam
    stages = {
        "frame_building": slam.frame_seconds,
        "tracking": slam.tracking_seconds,
        "mapping": slam.mapping_seconds,
        "refinement": state.finish_seconds,
        "saving": saving,
    }
    return {name: round(seconds / len(slam.trajectory), 5) for name, seconds in stages.items()}


def _listed(values: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in values.items())


def _metrics(state: Run, folder: Path) -> dict[str, Any]:
    """Return everything metrics.json says, and write the pictures the image metrics are taken from."""
    config, sequence, slam = state.config, state.sequence, state.slam
    truth = _true_trajectory(state)
    frames = len(slam.trajectory)
    mapper = slam.mapper
    return {
        "dataset": sequence.dataset,
        "scene": sequence.scene,
        "description": sequence.description,
        "method": config.method,
        **errors_of(state),
        "path_length_m": _rounded(truth.length()) if truth is not None else None,
        **_image_metrics(state, folder),
        "num_frames": frames,
        "num_lost_frames": sum(not r.converged for r in slam.results),
        "num_keyframes": len(mapper.keyframes) if isinstance(mapper, GaussianMapper) else None,
        "num_gaussians": mapper.num_gaussians if mapper is not None else 0,
        "num_events": state.num_events,
        "tracking_hz": _rounded(frames / (slam.frame_seconds + slam.tracking_seconds)),
        "tracking_s": _rounded(slam.frame_seconds + slam.tracking_seconds),
        "mapping_s": _rounded(slam.mapping_seconds),
        "refinement_s": _rounded(state.finish_seconds),
        "device": f"{config.device} ({platform.machine()}, {config.threads} threads)",
        "version": __version__,
        "is_interrupted": state.is_interrupted,
        "protocol": (
            f"poses {config.poses}; ATE: SE(3)-aligned rmse over all frames (sim3: with scale), RPE over "
            f"consecutive frames; images: every {config.evaluation.hold_out_every}th depth frame held out "
            "from mapping, rendered at its estimated pose, over pixels with true depth (_all: every "
            "pixel), corrected by EventNeRF's linear fit in log space"
        ),
    }


def _image_metrics(state: Run, folder: Path) -> dict[str, Any]:
    """Render the held-out views, write them beside the truth, and return their metrics."""
    evaluation, slam = state.config.evaluation, state.slam
    names = ("psnr_db", "psnr_corrected_db", "ssim_corrected", "lpips_corrected")
    nothing: dict[str, Any] = dict.fromkeys([*names, *(f"{n}_all" for n in names), "depth_l1_cm"])
    if slam.mapper is None:
        return nothing
    indices = sorted(k for k in state.held_out if k < len(slam.trajectory))
    indices = [indices[k] for k in _evenly(len(indices), evaluation.max_images)]
    views: list[View] = []
    samples = [state.samples[k] for k in indices]
    for k in indices:
        views.append(slam.mapper.render(state.sequence.camera, slam.trajectory.pose(k)))
    metrics = dict(nothing)
    renders, captions = [v.intensity for v in views], [""] * len(views)
    truths = [s.image for s in samples if s.image is not None]
    if views and len(truths) == len(views):
        masks = [s.depth > 0 if s.depth is not None else None for s in samples]
        measured = evaluate_images(renders, truths, masks, lpips_weights=evaluation.lpips_weights)
        for name in nothing:
            if hasattr(measured, name):
                metrics[name] = _rounded(getattr(measured, name))
        captions = _captions(renders, truths, masks)
    pairs = [(v.depth, s.depth) for v, s in zip(views, samples) if s.depth is not None]
    drawn = [np.where(rendered > 0, true, 0) for rendered, true in pairs]  # only where something is drawn
    if pairs:
        metrics["depth_l1_cm"] = _rounded(depth_l1_cm([rendered for rendered, _ in pairs], drawn))
    metrics["num_held_out_views"] = len(views)
    write_render_triptychs(
        folder / "renders",
        timestamps=[s.timestamp for s in samples],
        renders=renders,
        truths=[s.image for s in samples],
        depths=[v.depth for v in views],
        captions=captions,
    )
    return metrics


def _captions(
    renders: list[np.ndarray],  # V of [H, W]
    truths: list[np.ndarray],  # V of [H, W]
    masks: list[np.ndarray | None],  # V of [H, W] bool, counted pixels
) -> list[str]:
    """Return each view's PSNR after the fit over all views."""
    counted = [np.zeros(t.shape, bool) if m is None else m for t, m in zip(truths, masks)]
    if not any(m.any() for m in counted):
        return [""] * len(renders)
    fit = fit_event_nerf(renders, truths, counted)
    return [
        f"PSNR {psnr([fit(r)], [t], [m]):.1f} dB corrected" if m.any() else ""
        for r, t, m in zip(renders, truths, counted)
    ]


def _write_map(state: Run, mapper: Mapper, folder: Path) -> None:
    """Write map.ply (Gaussian maps), points.ply and mesh.ply."""
    points, brightness = mapper.points()
    if len(points) == 0:
        state.note("the map is empty: no map.ply, points.ply, mesh.ply")
        return
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
    trajectory = state.slam.trajectory

    def views() -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        for k in _evenly(len(trajectory), MESH_VIEWS):
            view = mapper.render(state.sequence.camera, trajectory.pose(k))
            yield np.where(view.alpha > 0.9, view.depth, 0), view.intensity, trajectory.pose(k)

    try:
        write_mesh(folder / "mesh.ply", fuse_mesh(views(), state.sequence.camera, MESH_VOXEL))
    except DataError as error:  # a map too thin for a surface: the other results stand
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
