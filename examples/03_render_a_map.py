"""python examples/03_render_a_map.py RESULT [PICTURE.png]

Load the map.ply of a run and render it from a pose that no frame had: 10 cm beside the middle of the path.
RESULT is a results folder, for instance results/builtin/office0/ed_slam/latest.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

import edslam_ti
from edslam_ti import kernels
from edslam_ti.camera import Camera
from edslam_ti.mapping.rendering import render_view
from edslam_ti.trajectory import read_tum


def main(result: Path, picture: Path = Path("view.png")) -> np.ndarray:
    """Render the map of a results folder to a PNG file; return its brightness [H, W]."""
    kernels.init("cpu", threads=2)
    gaussians = edslam_ti.load_map(result / "map.ply")
    trajectory = read_tum(result / "trajectory_tum.txt")
    T_world_camera = trajectory.pose(len(trajectory) // 2).copy()
    T_world_camera[:3, 3] += 0.1 * T_world_camera[:3, 0]  # metres, along the camera's x axis: to the right
    camera = Camera(width=640, height=400, fx=320.0, fy=320.0, cx=319.5, cy=199.5)  # any camera will do
    view = render_view(gaussians, camera, T_world_camera, background=0.5)
    cv2.imwrite(str(picture), np.round(255 * view.intensity.clip(0, 1)).astype(np.uint8))
    print(f"{len(gaussians)} Gaussians; they cover {view.alpha.mean():.0%} of {picture}")
    return view.intensity


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
