"""Everything that metrics.json says, by its names there and in its order."""

import platform
import resource
import sys
import time
from typing import Any

import numpy as np

from edslam_ti import __version__
from edslam_ti.errors import DataError
from edslam_ti.evaluation.meshes import mesh_errors
from edslam_ti.evaluation.trajectories import ate_rmse_cm, inceventgs_slice, trajectory_errors
from edslam_ti.evaluation.truth_notes import truth_notes
from edslam_ti.results.run import Run
from edslam_ti.results.trust import Trust
from edslam_ti.results.views import ViewNumbers
from edslam_ti.trajectory import Trajectory

Metrics = dict[str, Any]

# Names in metrics.json, and what they are called in TrajectoryErrors, ImageMetrics and SurfaceErrors.
TRAJECTORY_METRICS = {
    "ate_rmse_cm": "ate_rmse_cm",
    "ate_mean_cm": "ate_mean_cm",
    "ate_median_cm": "ate_median_cm",
    "ate_max_cm": "ate_max_cm",
    "ate_rmse_sim3_cm": "ate_rmse_sim3_cm",
    "rpe_trans_cm": "rpe_trans_cm",
    "rpe_rot_deg": "rpe_rot_deg",
}
VIEW_METRICS: dict[str, dict[str, str]] = {
    "held out": {
        "psnr_db": "psnr_db",
        "psnr_corrected_db": "psnr_corrected_db",
        "ssim_corrected": "ssim_corrected",
        "lpips_corrected": "lpips_corrected",
        "psnr_db_all": "psnr_db_all",
        "psnr_corrected_db_all": "psnr_corrected_db_all",
        "ssim_corrected_all": "ssim_corrected_all",
        "lpips_corrected_all": "lpips_corrected_all",
        "ssim_all": "ssim_all",
        "lpips_all": "lpips_all",
    },
    "mapped": {
        "psnr_mapped_db": "psnr_db",
        "psnr_mapped_corrected_db": "psnr_corrected_db",
        "ssim_mapped_corrected": "ssim_corrected",
        "lpips_mapped_corrected": "lpips_corrected",
        "psnr_mapped_db_all": "psnr_db_all",
        "psnr_mapped_corrected_db_all": "psnr_corrected_db_all",
        "ssim_mapped_corrected_all": "ssim_corrected_all",
        "lpips_mapped_corrected_all": "lpips_corrected_all",
        "ssim_mapped_all": "ssim_all",
        "lpips_mapped_all": "lpips_all",
    },
    "novel": {
        "psnr_novel_db": "psnr_db",
        "psnr_novel_corrected_db": "psnr_corrected_db",
        "ssim_novel_corrected": "ssim_corrected",
        "lpips_novel_corrected": "lpips_corrected",
        "psnr_novel_db_all": "psnr_db_all",
        "psnr_novel_corrected_db_all": "psnr_corrected_db_all",
        "ssim_novel_corrected_all": "ssim_corrected_all",
        "lpips_novel_corrected_all": "lpips_corrected_all",
        "ssim_novel_all": "ssim_all",
        "lpips_novel_all": "lpips_all",
    },
}
DEPTH_METRIC = {"held out": "depth_l1_cm", "mapped": "depth_l1_mapped_cm", "novel": "depth_l1_novel_cm"}
NUM_VIEWS = {"held out": "num_held_out_views", "mapped": "num_mapped_views", "novel": "num_novel_views"}
MESH_METRICS = {
    "mesh_accuracy_cm": "accuracy_cm",
    "mesh_completion_cm": "completion_cm",
    "mesh_completion_ratio_5cm": "completion_ratio",
}
INCEVENTGS_METRICS = {"psnr_corrected_db": "psnr_corrected_db_all", "ssim": "ssim_all", "lpips": "lpips_all"}


def run_metrics(
    run: Run,
    truth: Trajectory | None,  # at the tracked times
    slice_s: tuple[float, float] | None,  # seconds, of `slice_of`
    views: dict[str, ViewNumbers],  # by kind
    mesh: Any | None,  # Open3D TriangleMesh, None: the run made none
    trust: Trust,
) -> Metrics:
    """Return all metrics but those of `cost_metrics`."""
    config, sequence, slam = run.config, run.sequence, run.slam
    num_frames = len(slam.trajectory)
    measured = trajectory_metrics(run, truth) | _view_metrics(views) | _mesh_metrics(run, truth, mesh)
    of_map: Metrics = {} if slam.mapper is None else dict(slam.mapper.metrics())
    return {
        "dataset": sequence.dataset,
        "scene": sequence.scene,
        "description": sequence.description,
        "method": config.method,
        **measured,
        "time_offset_s": sequence.time_offset,
        "num_frames": num_frames,
        "num_lost_frames": sum(not r.converged for r in slam.results),
        "num_keyframes": of_map.pop("num_keyframes", None),
        "num_gaussians": slam.mapper.num_gaussians if slam.mapper is not None else 0,
        "num_events": run.num_events,
        "num_mapping_steps": of_map.pop("num_mapping_steps", None),
        "num_hot_pixels": of_map.pop("num_hot_pixels", None),
        **of_map,
        **trust.metrics(),
        "num_dropped_events": sequence.num_dropped_events,
        "data_notes": list(sequence.notes),
        "contrast_threshold": _rounded(run.contrast.value),
        "contrast_threshold_source": run.contrast.source,
        "contrast_threshold_positive": _rounded(run.contrast.positive),
        "contrast_threshold_negative": _rounded(run.contrast.negative),
        "contrast_threshold_deviation": _rounded(run.contrast.deviation),
        "tracking_hz": _rounded(num_frames / slam.tracking_seconds),
        "tracking_s": _rounded(slam.tracking_seconds),
        "mapping_s": _rounded(slam.mapping_seconds),
        "refinement_s": _rounded(run.finish_seconds),
        "device": f"{config.device} ({platform.machine()}, {config.threads} threads)",
        "version": __version__,
        "is_interrupted": run.is_interrupted,
        "protocol": _protocol(run),
        "protocols": {
            "full": _full_protocol(measured),
            "inceventgs": _inceventgs_protocol(run, truth, slice_s, views["held out"]),
        },
    }


def cost_metrics(run: Run, saving_seconds: float) -> Metrics:
    """Return the time of each stage and of the whole run until now, and the most memory."""
    slam, num_frames = run.slam, len(run.slam.trajectory)
    seconds = {
        "tracking": slam.tracking_seconds,
        "mapping": slam.mapping_seconds,
        "refinement": run.finish_seconds,
        "saving": saving_seconds,
    }
    wall_s = round(time.perf_counter() - run.started, 2)
    return {
        "seconds_per_frame": {stage: round(s / num_frames, 5) for stage, s in seconds.items()},
        "wall_s": wall_s,
        "total_fps": round(num_frames / wall_s, 3),
        "peak_memory_mb": round(_peak_memory_mb(), 1),
    }


# --- the trajectory ---


def trajectory_metrics(run: Run, truth: Trajectory | None) -> Metrics:
    """Return the trajectory's errors, the length of the true path and notes; None without (enough) truth.

    Errors are counted between the truth's own stamps; `truth`, at the tracked times, shows no holes.
    `ate_frontend_rmse_cm` is of the poses as they were tracked, before the mapper corrected any.
    """
    errors, frontend, notes = None, None, []
    coverage = None
    estimate, original = run.slam.trajectory, run.sequence.truth
    if original is not None:
        coverage = 0.0
        try:
            errors = trajectory_errors(estimate, original)
            coverage = errors.coverage
            frontend = ate_rmse_cm(run.slam.frontend_trajectory, original)
            lost = [k for k, result in enumerate(run.slam.results) if not result.converged]
            notes = truth_notes(estimate, original, errors, run.sequence.time_offset, lost)
        except DataError as error:
            notes = [str(error)]
    return {
        **_named(errors, TRAJECTORY_METRICS),
        "ate_frontend_rmse_cm": _rounded(frontend),
        "path_length_m": _rounded(None if truth is None else truth.length()),
        "ate_scale_sim3": None if errors is None else _rounded(errors.scale, 6),
        "num_truth_poses_compared": 0 if errors is None else errors.num_poses,
        "truth_coverage": _rounded(coverage),
        "truth_notes": notes,
    }


# --- views and mesh ---


def _view_metrics(views: dict[str, ViewNumbers]) -> Metrics:
    """Return the metrics of views of all kinds, None where there is nothing to measure."""
    metrics: Metrics = {}
    for kind, numbers in views.items():
        metrics |= _named(numbers.images, VIEW_METRICS[kind])
        metrics[DEPTH_METRIC[kind]] = _rounded(numbers.depth_l1_cm)
        metrics[NUM_VIEWS[kind]] = numbers.num_views
    return metrics


def _mesh_metrics(run: Run, truth: Trajectory | None, mesh: Any | None) -> Metrics:
    """Return the mesh's errors against the true surfaces that the camera saw; None without them."""
    errors = None
    if mesh is not None and run.sequence.surfaces_file is not None and truth is not None:
        errors = run.attempt(
            "mesh errors", lambda: mesh_errors(mesh, run.sequence, run.slam.trajectory), otherwise=None
        )
    return _named(errors, MESH_METRICS)


# --- protocols ---


def slice_of(run: Run, truth: Trajectory | None) -> tuple[float, float] | None:  # seconds
    """Return IncEventGS's slice of one of EventReplica's scenes; None: the path does not cover one."""
    if truth is None or run.sequence.truth is None or run.sequence.dataset != "event_replica":
        return None
    return inceventgs_slice(run.sequence.scene, run.sequence.truth, run.slam.trajectory)


def _protocol(run: Run) -> str:
    return (
        f"poses {run.config.poses}; ATE: SE(3)-aligned rmse over all frames (sim3: with scale), RPE over "
        f"consecutive frames; images: every {run.config.evaluation.hold_out_every}th depth frame held out "
        "from mapping, rendered at its estimated pose, over pixels with true depth (_all: every "
        "pixel), corrected by EventNeRF's linear fit in log space, one for each set of views; mapped: "
        "frames used for mapping; novel: true poses beside the path, moved into the estimate's frame, "
        "over pixels whose surface the path saw (_all: every pixel)"
    )


def _full_protocol(measured: Metrics) -> Metrics:
    """Return the results under the paper's protocol."""
    return {
        "trajectory": "whole run, rmse after SE(3) alignment",
        "images": "held-out views, pixels with true depth, all after EventNeRF's fit",
        "ate_rmse_cm": measured["ate_rmse_cm"],
        "psnr_corrected_db": measured["psnr_corrected_db"],
        "ssim_corrected": measured["ssim_corrected"],
        "lpips_corrected": measured["lpips_corrected"],
    }


def _inceventgs_protocol(
    run: Run,
    truth: Trajectory | None,
    slice_s: tuple[float, float] | None,
    held_out: ViewNumbers,
) -> Metrics:
    """Return the results under IncEventGS's protocol, over its slice of the scene where there is one."""
    trajectory = run.slam.trajectory
    ate = None
    if truth is not None:
        start, end = slice_s or (-np.inf, np.inf)
        inside = (trajectory.timestamps >= start) & (trajectory.timestamps <= end)
        part = Trajectory(trajectory.timestamps[inside], trajectory.poses[inside])
        assert run.sequence.truth is not None  # `truth` is it
        ate = ate_rmse_cm(part, run.sequence.truth, with_scale=True)
    where = (
        f"their slice, {slice_s[0]:g} to {slice_s[1]:g} s" if slice_s else "whole run (no slice of theirs)"
    )
    return {
        "trajectory": f"{where}, rmse after Sim(3) alignment",
        "images": "held-out views, all pixels; PSNR after EventNeRF's fit, SSIM and LPIPS before it",
        "ate_rmse_sim3_cm": _rounded(ate),
        **_named(held_out.images_in_slice if slice_s else held_out.images, INCEVENTGS_METRICS),
    }


def _named(errors: object | None, fields: dict[str, str]) -> Metrics:
    """Return fields of what was measured under their names in metrics.json, None where nothing was."""
    return {
        name: None if errors is None else _rounded(getattr(errors, field)) for name, field in fields.items()
    }


def _rounded(value: float | None, digits: int = 4) -> float | None:
    return None if value is None or not np.isfinite(value) else round(float(value), digits)


def _peak_memory_mb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10
