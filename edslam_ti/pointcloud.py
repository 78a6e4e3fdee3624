"""Depth images to points (Open3D)."""

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.open3d_loader import load_open3d

FARTHEST = 1e4  # metres; larger readings are errors of the file, not distances


def depth_to_points(
    depth: np.ndarray,  # [H, W] float32 metres, 0 = missing
    camera: Camera,
    T_world_camera: np.ndarray,  # [4, 4]
    mask: np.ndarray | None = None,  # [H, W] bool, pixels to use; None = all
) -> tuple[np.ndarray, np.ndarray]:  # [N, 3] float32 metres, world; [N, 2] int64 (x, y)
    """Return the world points of the pixels with depth, row by row, and those pixels.

    The legacy point cloud keeps the order of the pixels; Open3D's tensor one does not.
    """
    _check_image("depth", depth, camera)
    # Comparisons with NaN are false: such pixels count as missing.
    used = (depth > 0) & (depth < FARTHEST)
    if mask is not None:
        _check_image("mask", mask, camera)
        used &= mask
    o3d = load_open3d()
    cloud = o3d.geometry.PointCloud.create_from_depth_image(
        o3d.geometry.Image(np.ascontiguousarray(np.where(used, depth, 0), np.float32)),
        o3d.camera.PinholeCameraIntrinsic(camera.width, camera.height, *camera.intrinsics),
        np.linalg.inv(T_world_camera),
        depth_scale=1.0,
        depth_trunc=2 * FARTHEST,
    )
    points = np.asarray(cloud.points, dtype=np.float32).reshape(-1, 3)
    y, x = np.nonzero(used)
    return points, np.stack([x, y], -1)


def _check_image(name: str, image: np.ndarray, camera: Camera) -> None:
    if image.shape != camera.shape:
        raise DataError(f"{name}: expected shape {camera.shape} as the camera's, got {image.shape}")
