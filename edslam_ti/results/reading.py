"""A results folder read back."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.camera_file import read_camera
from edslam_ti.errors import DataError, LostTrackError, plain
from edslam_ti.journal import JOURNAL, read_journal
from edslam_ti.mesh_reading import read_point_cloud, read_triangle_mesh
from edslam_ti.output import atomic_file
from edslam_ti.results.run_folder import is_unfinished
from edslam_ti.trajectory import Trajectory, read_tum

CAMERA = "camera.json"
MOST_LOST = 0.1  # of the frames; beyond, a run's exit code says that its path is not to be trusted


READ_METRICS: dict[str, tuple[type, ...]] = {  # what is shown of metrics.json
    "scene": (str,),
    "method": (str,),
    "ate_rmse_cm": (float, int),
    "num_lost_frames": (int,),
    "num_frames": (int,),
}


@dataclass(frozen=True)
class Result:
    """What can be shown of a results folder; parts a run did not make are None."""

    folder: Path
    trajectory: Trajectory
    truth: Trajectory | None
    metrics: dict[str, Any]
    points: np.ndarray | None  # [N, 3] metres
    brightness: np.ndarray | None  # [N]
    mesh: Any | None  # open3d TriangleMesh

    @property
    def title(self) -> str:
        """Scene, method and ATE, as far as metrics.json tells, else the folder's name."""
        words = [plain(self.metrics[key], 80) for key in ("scene", "method") if self.metrics.get(key)]
        ate = self.metrics.get("ate_rmse_cm")
        name = " ".join(words) or self.folder.name
        name += " (unfinished)" if is_unfinished(self.folder) else ""
        return name if ate is None else f"{name}: ATE {ate:.2f} cm rmse"


def load_result(folder: Path) -> Result:
    """Read a results folder; it must hold `trajectory_tum.txt`, all else is optional.

    Of a run that was cut off, the path is read from its journal.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: results folder not found")
    trajectory_path, journal_path = folder / "trajectory_tum.txt", folder / JOURNAL
    if not trajectory_path.is_file() and not journal_path.is_file():
        raise DataError(
            f"{folder}: not a results folder (no trajectory_tum.txt); give one that `edslam slam` made"
        )
    truth_path, metrics = folder / "truth_tum.txt", _read_metrics(folder)
    points = brightness = mesh = None
    if (folder / "points.ply").is_file():
        cloud = read_point_cloud(folder / "points.ply")
        points = np.asarray(cloud.points)
        brightness = np.asarray(cloud.colors).mean(1) if cloud.has_colors() else np.full(len(points), 0.5)
    if (folder / "mesh.ply").is_file():
        mesh = read_triangle_mesh(folder / "mesh.ply")
    return Result(
        folder=folder,
        trajectory=read_tum(trajectory_path) if trajectory_path.is_file() else read_journal(journal_path),
        truth=read_tum(truth_path) if truth_path.is_file() else None,
        metrics=metrics,
        points=points,
        brightness=brightness,
        mesh=mesh,
    )


def write_camera(folder: Path, camera: Camera) -> None:
    """Write a run's camera into its folder, as recordings state theirs."""
    values = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    with atomic_file(folder / CAMERA) as temporary:
        temporary.write_text(json.dumps(values | {"pixel_centres": "integer"}, indent=2) + "\n")


def read_camera_of(folder: Path) -> Camera:
    """Return a run's camera; raises DataError where the folder does not say."""
    if not (folder / CAMERA).is_file():
        raise DataError(f"{folder}: no {CAMERA} in it; an older version made this run, run it again")
    return read_camera(folder / CAMERA).camera


def require_tracked(folder: Path) -> None:
    """Raise `LostTrackError` where more than a tenth of a run's frames was lost."""
    metrics = _read_metrics(folder)
    lost, frames = metrics.get("num_lost_frames") or 0, metrics.get("num_frames") or 0
    if lost > MOST_LOST * frames:
        raise LostTrackError(
            f"{lost} of {frames} frames were lost; log.txt says why. What there is has been saved to {folder}"
        )


def _read_metrics(folder: Path) -> dict[str, Any]:
    path = folder / "metrics.json"
    try:
        metrics: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    except (ValueError, RecursionError) as error:  # also huge integers, wrong encodings, deep nesting
        raise DataError(f"{path}: not readable as JSON ({plain(error)})") from error
    if not isinstance(metrics, dict):
        raise DataError(f"{path}: expected an object of metrics, got {plain(metrics, 60)}")
    for name, kinds in READ_METRICS.items():
        if not isinstance(metrics.get(name), (*kinds, type(None))):
            raise DataError(f"{path}: {name}: expected {kinds[0].__name__}, got {plain(metrics[name], 60)}")
    return metrics
