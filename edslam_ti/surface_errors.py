"""A reconstructed mesh against the true surfaces: accuracy and completion (Zhu et al. 2022, NICE-SLAM)."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.open3d_loader import load_open3d

NUM_SAMPLES = 100_000  # points drawn on a reconstructed mesh
SPACING = 0.02  # metres; one true point is kept of those that fall into a cube of this size
COMPLETE_WITHIN = 0.05  # metres


@dataclass(frozen=True)
class SurfaceErrors:
    """How far two surfaces are apart."""

    accuracy_cm: float  # mean distance of the mesh from the true surfaces
    completion_cm: float  # mean distance of the true points that a camera saw from the mesh
    completion_ratio: float  # share of those points with the mesh within 5 cm


class TrueSurfaces:
    """The triangles of a scene."""

    def __init__(self, path: Path) -> None:
        self._scene = _ray_casting(read_triangles(path))

    def seen_points(
        self,
        camera: Camera,
        poses: Iterable[np.ndarray],  # [4, 4] T_world_camera
    ) -> np.ndarray:  # [N, 3] float32 metres, world
        """Return points evenly spread over what cameras at these poses see, every other pixel looked at."""
        o3d = load_open3d()
        rays = camera.downscaled(2).rays()  # [H / 2, W / 2, 3], z = 1
        kept = [np.empty((0, 3), np.float32)]
        for T in poses:
            directions = rays @ T[:3, :3].T
            origins = np.broadcast_to(T[:3, 3], directions.shape)
            cast = np.concatenate([origins, directions], -1).astype(np.float32)
            depth = self._scene.cast_rays(o3d.core.Tensor(cast))["t_hit"].numpy()
            hit = np.isfinite(depth)
            kept.append((origins[hit] + depth[hit][:, None] * directions[hit]).astype(np.float32))
        points = np.concatenate(kept)
        _, first = np.unique(np.floor(points / SPACING).astype(np.int64), axis=0, return_index=True)
        return points[np.sort(first)]

    def errors(
        self,
        mesh: Any,  # Open3D TriangleMesh
        seen: np.ndarray,  # [N, 3] metres
        T_world_estimate: np.ndarray,  # [4, 4], from the mesh's frame to that of the surfaces
        seed: int = 0,
    ) -> SurfaceErrors:
        """Compare a mesh with the surfaces."""
        if len(mesh.triangles) == 0 or len(seen) == 0:
            raise DataError(
                f"mesh errors: expected triangles and points that a camera saw, got {len(mesh.triangles)} "
                f"triangles and {len(seen)} points"
            )
        o3d = load_open3d()
        o3d.utility.random.seed(seed)
        moved = o3d.geometry.TriangleMesh(mesh).transform(T_world_estimate)
        drawn = np.asarray(moved.sample_points_uniformly(NUM_SAMPLES).points, np.float32)
        to_truth = self._scene.compute_distance(o3d.core.Tensor(drawn)).numpy()
        to_mesh = _ray_casting(moved).compute_distance(o3d.core.Tensor(seen)).numpy()
        return SurfaceErrors(
            100 * float(to_truth.mean()),
            100 * float(to_mesh.mean()),
            float((to_mesh <= COMPLETE_WITHIN).mean()),
        )


def read_triangles(path: Path) -> Any:
    """Return the Open3D TriangleMesh in a file."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: mesh not found")
    mesh = load_open3d().io.read_triangle_mesh(str(path))
    if len(mesh.triangles) == 0:
        raise DataError(f"{path}: expected a mesh, could not read any triangle")
    return mesh


def _ray_casting(mesh: Any) -> Any:
    o3d = load_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    return scene
