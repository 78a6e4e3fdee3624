"""The path of a camera in the files of other programs: KITTI, COLMAP, nerfstudio.

Pixel centres are at integers here and at halves there, so principal points move by half a pixel. Cameras
look along z with y down here and in KITTI and COLMAP; nerfstudio's look along -z with y up (OpenGL).
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.camera import Camera
from edslam_ti.geometry import inverse
from edslam_ti.output import atomic_file
from edslam_ti.trajectory import Trajectory

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # T_opencv_opengl
IMAGE = "frame_{:05d}.png"


def image_names(trajectory: Trajectory) -> list[str]:
    """Return the names of the images at the poses of a path."""
    return [IMAGE.format(k) for k in range(len(trajectory))]


def write_kitti(
    trajectory: Trajectory,
    path: Path,
    times_path: Path,
) -> None:
    """Write poses in the first camera's frame, 12 numbers a line (3x4, by rows), and their stamps apart."""
    relative = inverse(trajectory.pose(0)) @ trajectory.poses
    _write(path, [" ".join(f"{x:.9e}" for x in T[:3].ravel()) for T in relative])
    _write(times_path, [f"{t:.9f}" for t in trajectory.timestamps])


def write_colmap(
    folder: Path,
    trajectory: Trajectory,
    camera: Camera,
    points: np.ndarray,  # [N, 3] metres, world
    brightness: np.ndarray,  # [N] in [0, 1]
) -> None:
    """Write cameras.txt, images.txt (world to camera) and points3D.txt of a COLMAP model."""
    size = f"{camera.width} {camera.height}"
    lens = " ".join(_number(x) for x in _half_centred(camera))
    _write(
        folder / "cameras.txt", ["# camera, model, width, height, fx, fy, cx, cy", f"1 PINHOLE {size} {lens}"]
    )
    lines = ["# image, qw, qx, qy, qz, tx, ty, tz, camera, name; then a line of its points, here empty"]
    for k, (T, name) in enumerate(zip(trajectory.poses, image_names(trajectory)), start=1):
        T_camera_world = inverse(T)
        q = Rotation.from_matrix(T_camera_world[:3, :3]).as_quat(scalar_first=True)
        pose = " ".join(_number(x) for x in (*q, *T_camera_world[:3, 3]))
        lines += [f"{k} {pose} 1 {name}", ""]
    _write(folder / "images.txt", lines)
    grey = np.rint(255 * np.clip(brightness, 0, 1)).astype(int)
    lines = ["# point, x, y, z, r, g, b, error; no tracks"]
    for k, ((x, y, z), g) in enumerate(zip(points, grey), start=1):
        lines.append(f"{k} {x:.6f} {y:.6f} {z:.6f} {g} {g} {g} 0")
    _write(folder / "points3D.txt", lines)


def write_nerfstudio(path: Path, trajectory: Trajectory, camera: Camera, images: str) -> None:
    """Write transforms.json: camera to world with OpenGL's axes; `images` is the folder of the images."""
    fx, fy, cx, cy = _half_centred(camera)
    document = {
        "camera_model": "OPENCV",
        **{"w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy},
        **{"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0},
        "frames": [
            {"file_path": f"{images}/{name}", "time": float(t), "transform_matrix": (T @ OPENGL).tolist()}
            for t, T, name in zip(trajectory.timestamps, trajectory.poses, image_names(trajectory))
        ],
    }
    _write(path, [json.dumps(document, indent=1)])


def _half_centred(camera: Camera) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy where the first pixel is centred at (0.5, 0.5)."""
    return camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5


def _number(value: float) -> str:
    return f"{value:.12g}"


def _write(path: Path, lines: Sequence[str]) -> None:
    with atomic_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
