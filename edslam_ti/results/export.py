"""What a run leaves behind for other programs: points and a mesh, as PLY."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.mapping.gaussian_ply import three_channels
from edslam_ti.mapping.volume import TsdfVolume
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.output import atomic_file


def write_points(
    path: Path,
    points: np.ndarray,  # [N, 3] metres, world
    colors: np.ndarray,  # [N], [N, 1] or [N, 3] in [0, 1]
) -> None:
    """Write a coloured point cloud."""
    if len(points) == 0:
        raise DataError(f"{path.name}: the map holds no points; was there any depth to map?")
    if len(points) != len(colors):
        raise DataError(f"colors: expected one per point ({len(points)}), got {len(colors)}")
    o3d = load_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, np.float64)))
    cloud.colors = o3d.utility.Vector3dVector(np.clip(three_channels(colors), 0, 1).astype(np.float64))
    with atomic_file(path) as temporary:
        if not o3d.io.write_point_cloud(str(temporary), cloud):
            raise DataError(
                f"{path}: Open3D could not write this point cloud; check the folder and the suffix"
            )


def fuse_mesh(
    frames: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]],
    camera: Camera,
    voxel_size: float,
) -> Any:
    """Return the mesh of a TSDF volume over views (depth [H, W], brightness [H, W], T_world_camera)."""
    volume = TsdfVolume(camera, voxel_size)
    for depth, brightness, T_world_camera in frames:
        volume.integrate(depth, brightness, T_world_camera)
    return volume.mesh()


def write_mesh(path: Path, mesh: Any) -> None:
    """Write an Open3D TriangleMesh."""
    if len(mesh.triangles) == 0:
        raise DataError(f"{path.name}: no surface was found; was there any depth to map?")
    o3d = load_open3d()
    with atomic_file(path) as temporary:
        if not o3d.io.write_triangle_mesh(str(temporary), mesh):
            raise DataError(f"{path}: Open3D could not write this mesh; check the folder and the suffix")
