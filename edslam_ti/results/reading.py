"""A results folder read back."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.mesh_reading import read_point_cloud, read_triangle_mesh
from edslam_ti.trajectory import Trajectory, read_tum


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
        words = [str(self.metrics[key]) for key in ("scene", "method") if self.metrics.get(key)]
        ate = self.metrics.get("ate_rmse_cm")
        name = " ".join(words) or self.folder.name
        return name if ate is None else f"{name}: ATE {ate:.2f} cm rmse"


def load_result(folder: Path) -> Result:
    """Read a results folder; it must hold `trajectory_tum.txt`, all else is optional."""
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: results folder not found")
    trajectory_path = folder / "trajectory_tum.txt"
    if not trajectory_path.is_file():
        raise DataError(
            f"{folder}: not a results folder (no trajectory_tum.txt); give one that `edslam slam` made"
        )
    truth_path, metrics_path = folder / "truth_tum.txt", folder / "metrics.json"
    try:
        metrics = json.loads(metrics_path.read_text()) if metrics_path.is_file() else {}
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{metrics_path}: not readable as JSON ({error})") from error
    points = brightness = mesh = None
    if (folder / "points.ply").is_file():
        cloud = read_point_cloud(folder / "points.ply")
        points = np.asarray(cloud.points)
        brightness = np.asarray(cloud.colors).mean(1) if cloud.has_colors() else np.full(len(points), 0.5)
    if (folder / "mesh.ply").is_file():
        mesh = read_triangle_mesh(folder / "mesh.ply")
    return Result(
        folder=folder,
        trajectory=read_tum(trajectory_path),
        truth=read_tum(truth_path) if truth_path.is_file() else None,
        metrics=metrics,
        points=points,
        brightness=brightness,
        mesh=mesh,
    )
