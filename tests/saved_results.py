"""A small results folder to read and to draw."""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.camera import Camera
from edslam_ti.results.export import fuse_mesh, write_mesh, write_points
from edslam_ti.trajectory import Trajectory, write_tum

CAMERA = Camera(width=80, height=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)


def curve(count: int = 40) -> Trajectory:
    times = np.linspace(0, 2, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.stack([np.sin(times), 0.1 * times, 0.3 * np.cos(2 * times)], -1)
    poses[:, :3, :3] = Rotation.from_rotvec(times[:, None] * [0, 0.2, 0]).as_matrix()
    return Trajectory(times, poses)


def write_result(folder: Path) -> Path:
    """Write trajectory, metrics, mesh and points into a folder; return it."""
    write_tum(curve(), folder / "trajectory_tum.txt")
    (folder / "metrics.json").write_text(
        json.dumps({"scene": "office0", "method": "ed_slam", "ate_rmse_cm": 0.42})
    )
    y, x = np.mgrid[0:60, 0:80]
    brightness = 0.5 + 0.4 * np.sin(x / 5) * np.cos(y / 7)
    view = (np.full(CAMERA.shape, 1.5, np.float32), brightness, curve().pose(0))
    write_mesh(folder / "mesh.ply", fuse_mesh([view], CAMERA, voxel_size=0.03))
    points = np.random.default_rng(0).normal(size=(500, 3)) * 0.3 + [0, 0, 1.5]
    write_points(folder / "points.ply", points, np.linspace(0, 1, 500))
    return folder
