"""The results folder of a run: trajectory, map, pictures and numbers, written whole or not at all."""

import json
import os
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from edslam_ti.depth_images import without_depth_edges
from edslam_ti.evaluation.images import LinearFit
from edslam_ti.mapping.mapper import Mapper
from edslam_ti.output import atomic_folder
from edslam_ti.results.export import fuse_mesh, write_mesh, write_points
from edslam_ti.results.metrics import Metrics, cost_metrics, run_metrics, slice_of
from edslam_ti.results.pictures import fly_through_frames, smooth_path, write_video
from edslam_ti.results.plots import plot_trajectory
from edslam_ti.results.run import Run
from edslam_ti.results.trust import Trust
from edslam_ti.results.views import save_views
from edslam_ti.trajectory import write_tum

MESH_VOXEL = 0.02  # metres
MESH_ALPHA = 0.5  # pixels less opaque, which have no median depth, are left out of the mesh
MESH_STEP, MESH_TURN = 0.1, 5.0  # metres, degrees between the views that are fused
VIDEO_FPS = 15.0


def save(run: Run, console: Console) -> Path:
    """Write the results folder, whole or not at all, point `latest` to it, and return it."""
    config, slam = run.config, run.slam
    parent = config.out / run.sequence.dataset / run.sequence.scene / config.method
    folder = _unused(parent / datetime.now().strftime("%Y-%m-%d_%H-%M-%S"))
    started = time.perf_counter()
    truth, trust = run.true_trajectory(), Trust.of(slam)
    slice_s = slice_of(run, truth)
    with console.status("saving"), atomic_folder(folder) as partial:
        offset = run.sequence.time_offset  # files carry the recording's own stamps
        write_tum(slam.trajectory, partial / "trajectory_tum.txt", offset)
        write_tum(slam.frontend_trajectory, partial / "trajectory_frontend_tum.txt", offset)
        if truth is not None:
            write_tum(truth, partial / "truth_tum.txt", offset)
        run.attempt("poses.csv", lambda: trust.write(partial / "poses.csv", offset), otherwise=None)
        (partial / "config.yaml").write_text(config.to_yaml())
        _write_log(run, partial)
        views = save_views(run, truth, slice_s, partial / "renders")
        mesh = _save_map(run, views["held out"].fit, partial)
        metrics = run_metrics(run, truth, slice_s, views, mesh, trust)
        _draw_trajectory(run, trust, partial / "trajectory.png")
        metrics |= cost_metrics(run, saving_seconds=time.perf_counter() - started)
        (partial / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
        for line in (*metrics["truth_notes"], *metrics["problems"]):
            run.note(line)
        run.note("seconds per frame: " + _listed(metrics["seconds_per_frame"]))
        run.note("saved")
        _write_log(run, partial)
    _point_latest_to(folder)
    _print_summary(metrics, run.left_out, console)
    return folder


def _write_log(run: Run, folder: Path) -> None:
    (folder / "log.txt").write_text("\n".join(run.messages) + "\n")


def _draw_trajectory(run: Run, trust: Trust, path: Path) -> None:
    estimates = {run.config.method: run.slam.trajectory}
    sigmas = trust.sigmas[0] if trust.is_measured else None
    run.attempt(
        path.name, lambda: plot_trajectory(path, estimates, run.sequence.truth, sigmas), otherwise=None
    )


# --- the map ---


def _save_map(run: Run, fit: LinearFit | None, folder: Path) -> Any | None:
    """Write the map's files, points, mesh and fly-through; return the mesh, None where there is none."""
    mapper = run.slam.mapper
    if mapper is None:
        return None
    points, brightness = mapper.points()
    if len(points) == 0:
        run.note("the map is empty: no map.ply, points.ply, mesh.ply, flythrough.mp4")
        return None
    run.attempt("map.ply", lambda: mapper.save(folder), otherwise=None)
    points_file = folder / "points.ply"
    run.attempt("points.ply", lambda: write_points(points_file, points, brightness), otherwise=None)
    mesh = _write_mesh(run, mapper, folder / "mesh.ply")
    _write_fly_through(run, mapper, fit, folder / "flythrough.mp4")
    return mesh


def _write_mesh(run: Run, mapper: Mapper, path: Path) -> Any | None:
    """Fuse views of the map along the path into a mesh and write it; None where there is no surface."""

    def views() -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        for T in run.slam.trajectory.spread(MESH_STEP, MESH_TURN):
            view = mapper.render(run.sequence.camera, T, measured_only=True)
            opaque = np.where(view.alpha > MESH_ALPHA, view.depth, 0)
            yield without_depth_edges(opaque), view.intensity, T

    def made() -> Any:
        mesh = fuse_mesh(views(), run.sequence.camera, MESH_VOXEL)
        write_mesh(path, mesh)
        return mesh

    return run.attempt(path.name, made, otherwise=None)  # a map too thin has no surface


def _write_fly_through(run: Run, mapper: Mapper, fit: LinearFit | None, path: Path) -> None:
    """Write a video of the map along the smoothed path, brightness corrected where the truth is known."""

    def views() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for T in smooth_path(run.slam.trajectory, VIDEO_FPS, run.config.evaluation.flythrough_frames):
            view = mapper.render(run.sequence.camera, T)
            yield view.intensity if fit is None else fit(view.intensity), view.depth

    frames = fly_through_frames(views())
    run.attempt(path.name, lambda: write_video(path, frames, VIDEO_FPS), otherwise=None)


# --- the folder ---


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


def _listed(values: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in values.items())


def _print_summary(metrics: Metrics, left_out: list[str], console: Console) -> None:
    def show(name: str, unit: str) -> str:
        value = metrics.get(name)
        return "-" if value is None else f"{value:.2f} {unit}"

    scale, coverage = metrics["ate_scale_sim3"], metrics["truth_coverage"]
    of_scale = "" if scale is None else f" (Sim(3) {show('ate_rmse_sim3_cm', 'cm')}, scale {scale:.4f})"
    of_truth = of_sigma = ""
    if metrics["sigma_position_end_cm"] is not None:
        of_sigma = (
            f"sigma {show('sigma_position_median_cm', 'cm')} (end {show('sigma_position_end_cm', 'cm')}), "
        )
    if coverage is not None:
        of_truth = f"{metrics['num_truth_poses_compared']} compared with truth ({100 * coverage:.0f} %), "
    console.print(
        f"ATE {show('ate_rmse_cm', 'cm')}{of_scale}  RPE {show('rpe_trans_cm', 'cm')}, "
        f"{show('rpe_rot_deg', 'deg')}  "
        f"PSNR {show('psnr_corrected_db', 'dB')} corrected, {show('psnr_db', 'dB')} raw  "
        f"depth L1 {show('depth_l1_cm', 'cm')}\n"
        f"{metrics['num_frames']} frames, {metrics['num_lost_frames']} lost, {of_sigma}{of_truth}"
        f"{metrics['num_gaussians']} Gaussians, tracking {show('tracking_hz', 'Hz')}, "
        f"{metrics['wall_s']:.0f} s in all, {metrics['peak_memory_mb']:.0f} MB"
    )
    for line in (*metrics["data_notes"], *metrics["problems"], *metrics["truth_notes"], *left_out):
        console.print(line, style="yellow", markup=False, highlight=False, soft_wrap=True)
