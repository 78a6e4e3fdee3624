"""The results of a run in its folder: path, map, pictures and numbers, each file whole or not at all."""

import json
import time
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Console
from rich.text import Text

from edslam_ti.depth_images import without_depth_edges
from edslam_ti.errors import LONGEST_MESSAGE, plain
from edslam_ti.evaluation.images import LinearFit
from edslam_ti.event_images.sensor import estimate_sensor
from edslam_ti.interruption import Interruption, Stopped
from edslam_ti.mapping.mapper import Mapper
from edslam_ti.output import atomic_file
from edslam_ti.patient_console import say
from edslam_ti.results.export import fuse_mesh, write_mesh, write_points
from edslam_ti.results.metrics import Metrics, cost_metrics, run_metrics, slice_of
from edslam_ti.results.pictures import fly_through_frames, smooth_path, write_video
from edslam_ti.results.plots import plot_trajectory
from edslam_ti.results.run import Run
from edslam_ti.results.sensor import plot_sensor, sensor_lines, sensor_metrics
from edslam_ti.results.trust import Trust
from edslam_ti.results.views import KINDS, ViewNumbers, save_views
from edslam_ti.trajectory import write_tum

MESH_VOXEL = 0.02  # metres
MESH_ALPHA = 0.5  # pixels less opaque, which have no median depth, are left out of the mesh
MESH_STEP, MESH_TURN = 0.1, 5.0  # metres, degrees between the views that are fused
VIDEO_FPS = 15.0
# An input that is missing or cannot be used, or numbers without a solution: the others stand.
MISSING = (ValueError, FileNotFoundError)
NO_VIEWS = {kind: ViewNumbers(0, None, None, None) for kind in KINDS}

T = TypeVar("T")


def save(run: Run, folder: Path, console: Console, interruption: Interruption) -> Metrics | None:
    """Write the results into a run's folder, the path and the map first; return the metrics.

    Parts that fail are noted and left out. Where the cause is no input's fault, such as a full disk, its
    exception is raised when everything else is written. None: the metrics were left out.
    """
    slam, mapper = run.slam, run.slam.mapper
    parts = Parts(run, interruption)
    started = time.perf_counter()
    with console.status("saving"), interruption.saving():
        offset = run.sequence.time_offset  # files carry the recording's own stamps
        paths = {
            "trajectory_tum.txt": slam.trajectory,
            "trajectory_frontend_tum.txt": slam.frontend_trajectory,
        }
        for name, path in paths.items():
            parts.write("trajectory", partial(write_tum, path, folder / name, offset))
        has_map = mapper is not None and parts.write("map", lambda: _save_map(run, folder)) is True
        parts.write("log", lambda: _write_log(run, folder))
        truth = parts.add("truth", run.true_trajectory)
        if truth is not None:
            parts.add("truth", lambda: write_tum(truth, folder / "truth_tum.txt", offset))
        trust = parts.write("check of the data", lambda: Trust.of(slam)) or Trust.unknown(slam)
        parts.add("poses.csv", lambda: trust.write(folder / "poses.csv", offset))
        parts.add("picture of the path", lambda: _draw_trajectory(run, trust, folder / "trajectory.png"))
        slice_s = parts.add("slice", lambda: slice_of(run, truth))
        views = parts.add("views", lambda: save_views(run, truth, slice_s, folder / "renders")) or NO_VIEWS
        mesh = None
        if has_map and mapper is not None:
            parts.add("points", lambda: write_points(folder / "points.ply", *mapper.points()))
            mesh = parts.add("mesh", lambda: _write_mesh(run, mapper, folder / "mesh.ply"))
            fit, video = views["held out"].fit, folder / "flythrough.mp4"
            parts.add("fly-through", lambda: _write_fly_through(run, mapper, fit, video))
        sensor = parts.add("sensor", lambda: _describe_sensor(run, folder / "sensor.png"))
        metrics = parts.add("metrics", lambda: run_metrics(run, truth, slice_s, views, mesh, trust))
        if metrics is None:  # without the mesh and the path, which could not be measured
            metrics = parts.add(
                "metrics of the path", lambda: run_metrics(run, truth, slice_s, views, None, trust)
            )
        if metrics is None:
            metrics = parts.write("metrics", lambda: run_metrics(run, None, None, NO_VIEWS, None, trust))
        if metrics is not None:
            metrics |= {"sensor": sensor}
            numbers = metrics | cost_metrics(run, saving_seconds=time.perf_counter() - started)
            text = json.dumps(numbers, indent=2) + "\n"
            parts.write("metrics", lambda: _write_text(folder / "metrics.json", text))
            for line in (*numbers["data_notes"], *numbers["problems"], *numbers["truth_notes"]):
                run.note_once(line)
            run.note("seconds per frame: " + _listed(numbers["seconds_per_frame"]))
            metrics = numbers
        run.note("saved" if parts.error is None else f"not all could be saved: {parts.error}")
        parts.write("log", lambda: _write_log(run, folder))
    for line in (*parts.left_out, *run.left_out):
        say(console, line)
    if parts.error is not None:
        raise parts.error
    if metrics is not None:
        _print_summary(metrics, console)
    return metrics


class Parts:
    """Makes a results folder part by part: one that fails is noted, and the others stand."""

    def __init__(self, run: Run, interruption: Interruption) -> None:
        self.error: Exception | None = None  # the first that is no input's fault
        self.left_out: list[str] = []  # a line each
        self._run = run
        self._interruption = interruption

    def write(self, what: str, action: Callable[[], T]) -> T | None:
        """Return what an action returns, None where it fails; for what must be saved whatever happens."""
        try:
            return action()
        except MISSING as error:
            self._note(what, str(error))
        except Exception as error:
            self._note(what, _reason(error))
            self.error = self.error or error
        return None

    def add(self, what: str, action: Callable[[], T]) -> T | None:
        """Return what an action returns, None where it fails; a signal breaks it off, and it is left out."""
        if self._interruption.is_urgent:
            self._note(what, "interrupted")
            return None
        try:
            with self._interruption.breakable():
                return self.write(what, action)
        except Stopped:
            self._note(what, "interrupted")
            return None

    def _note(self, what: str, reason: str) -> None:
        line = plain(f"left out: {what}: {reason}", LONGEST_MESSAGE)
        self._run.note(line)
        self.left_out.append(line)


def _reason(error: Exception) -> str:
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"


def _write_log(run: Run, folder: Path) -> None:
    lines = [plain(message, LONGEST_MESSAGE) for message in run.messages]
    _write_text(folder / "log.txt", "\n".join(lines) + "\n")


def _write_text(path: Path, text: str) -> None:
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _describe_sensor(run: Run, path: Path) -> Metrics | None:
    """Draw what the recording says about its event sensor; return it. None: there are no events."""
    if not run.sequence.has_events:
        return None
    estimate = estimate_sensor(run.sequence, *(float(t) for t in run.samples.timestamps[[0, -1]]))
    for line in sensor_lines(estimate, run.contrast):
        run.note(f"sensor: {line}")
    plot_sensor(estimate, run.contrast, path)
    return sensor_metrics(estimate, run.contrast)


def _draw_trajectory(run: Run, trust: Trust, path: Path) -> None:
    paths = {run.config.method: run.slam.trajectory}
    plot_trajectory(path, paths, run.sequence.truth, trust.sigmas[0] if trust.is_measured else None)


# --- the map ---


def _save_map(run: Run, folder: Path) -> bool:
    """Write the map's own files; return whether there is anything in it."""
    mapper = run.slam.mapper
    if mapper is None:
        return False
    points, _ = mapper.points()
    if len(points) == 0:
        run.note("the map is empty: no map.ply, points.ply, mesh.ply, flythrough.mp4")
        return False
    mapper.save(folder)
    return True


def _write_mesh(run: Run, mapper: Mapper, path: Path) -> Any | None:
    """Fuse views of the map along the path into a mesh and write it; None where there is no surface."""

    def views() -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        for T in run.slam.trajectory.spread(MESH_STEP, MESH_TURN):
            view = mapper.render(run.sequence.camera, T, measured_only=True)
            opaque = np.where(view.alpha > MESH_ALPHA, view.depth, 0)
            yield without_depth_edges(opaque), view.intensity, T

    mesh = fuse_mesh(views(), run.sequence.camera, MESH_VOXEL)
    write_mesh(path, mesh)  # a map too thin for a surface is an error: the other results stand
    return mesh


def _write_fly_through(run: Run, mapper: Mapper, fit: LinearFit | None, path: Path) -> None:
    """Write a video of the map along the smoothed path, brightness corrected where the truth is known."""

    def views() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for T in smooth_path(run.slam.trajectory, VIDEO_FPS, run.config.evaluation.flythrough_frames):
            view = mapper.render(run.sequence.camera, T)
            yield view.intensity if fit is None else fit(view.intensity), view.depth

    write_video(path, fly_through_frames(views()), VIDEO_FPS)


def _listed(values: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in values.items())


def _print_summary(metrics: Metrics, console: Console) -> None:
    def show(name: str, unit: str) -> str:
        value = metrics.get(name)
        return "-" if value is None else f"{value:.2f} {unit}"

    scale, coverage = metrics["ate_scale_sim3"], metrics["truth_coverage"]
    of_scale = "" if scale is None else f" (Sim(3) {show('ate_rmse_sim3_cm', 'cm')}, scale {scale:.4f})"
    of_truth = of_sigma = ""
    if metrics["sigma_position_end_cm"] is not None:
        at_end = show("sigma_position_end_cm", "cm")
        of_sigma = f"sigma {show('sigma_position_median_cm', 'cm')} (end {at_end}), "
    if coverage is not None:
        of_truth = f"{metrics['num_truth_poses_compared']} compared with truth ({100 * coverage:.0f} %), "
    say(
        console,
        f"ATE {show('ate_rmse_cm', 'cm')}{of_scale}  RPE {show('rpe_trans_cm', 'cm')}, "
        f"{show('rpe_rot_deg', 'deg')}  "
        f"PSNR {show('psnr_corrected_db', 'dB')} corrected, {show('psnr_db', 'dB')} raw  "
        f"depth L1 {show('depth_l1_cm', 'cm')}\n"
        f"{metrics['num_frames']} frames, {metrics['num_lost_frames']} lost, {of_sigma}{of_truth}"
        f"{metrics['num_gaussians']} Gaussians, tracking {show('tracking_hz', 'Hz')}, "
        f"{metrics['wall_s']:.0f} s in all, {metrics['peak_memory_mb']:.0f} MB",
    )
    for line in (*metrics["data_notes"], *metrics["problems"], *metrics["truth_notes"]):
        console.print(Text(plain(line), "yellow"), soft_wrap=True, highlight=False)
