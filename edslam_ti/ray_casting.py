"""Casts rays at triangles with Open3D (CPU, no display needed); no other file makes an Open3D scene."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.open3d_loader import load_open3d


@dataclass(frozen=True)
class Hits:
    """First hits of rays; arrays have the shape of the rays without their last axis."""

    distance: np.ndarray  # [...] float32, in lengths of the ray's direction; infinite: nothing hit
    triangle: np.ndarray  # [...] uint32 index of the triangle, undefined where nothing is hit
    uv: np.ndarray  # [..., 2] float32 weights of the triangle's second and third corner
    normal: np.ndarray  # [..., 3] float32 unit normal of the triangle

    @property
    def depth(self) -> np.ndarray:  # [...] float32
        """The distance, 0 where nothing is hit: metres along the optical axis for `pixel_rays`."""
        return np.where(np.isfinite(self.distance), self.distance, 0).astype(np.float32)


class RayCaster:
    """Casts rays at triangles, and measures distances to them."""

    def __init__(
        self,
        vertices: np.ndarray,  # [V, 3] metres
        triangles: np.ndarray,  # [T, 3] indices of vertices; may be empty: no ray hits anything
    ) -> None:
        o3d = load_open3d()
        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        if len(triangles):
            self._scene.add_triangles(
                self._tensor(np.ascontiguousarray(vertices, np.float32)),
                self._tensor(np.ascontiguousarray(triangles, np.uint32)),
            )

    @classmethod
    def of_mesh(cls, mesh: Any) -> "RayCaster":
        """Return a ray caster of an Open3D TriangleMesh."""
        return cls(np.asarray(mesh.vertices), np.asarray(mesh.triangles))

    def cast(
        self,
        rays: np.ndarray,  # [..., 6] float32: origin, direction of any length
    ) -> Hits:
        """Return the first hit of every ray."""
        hits = self._scene.cast_rays(self._tensor(rays))
        return Hits(
            distance=hits["t_hit"].numpy(),
            triangle=hits["primitive_ids"].numpy(),
            uv=hits["primitive_uvs"].numpy(),
            normal=hits["primitive_normals"].numpy(),
        )

    def is_blocked(
        self,
        rays: np.ndarray,  # [N, 6] float32: origin, direction of any length
        near: float,
        far: float,
    ) -> np.ndarray:  # [N] bool
        """Return whether rays hit something between `near` and `far` lengths of their direction."""
        return np.asarray(self._scene.test_occlusions(self._tensor(rays), tnear=near, tfar=far).numpy())

    def distances_to(
        self,
        points: np.ndarray,  # [N, 3] float32 metres
    ) -> np.ndarray:  # [N] float32 metres
        """Return the distance of points from the nearest triangle."""
        return np.asarray(self._scene.compute_distance(self._tensor(points)).numpy())


def rays_from(
    T_world_camera: np.ndarray,  # [4, 4]
    directions: np.ndarray,  # [..., 3] camera frame
) -> np.ndarray:  # [..., 6] float32, world
    """Return rays from a camera's centre."""
    turned = directions @ T_world_camera[:3, :3].T
    origins = np.broadcast_to(T_world_camera[:3, 3], turned.shape)
    return np.concatenate([origins, turned], -1).astype(np.float32)


def pixel_rays(camera: Camera, T_world_camera: np.ndarray) -> np.ndarray:  # [H, W, 6] float32, world
    """Return the viewing rays of all pixels, of length 1 along the optical axis: distances are depths."""
    return rays_from(T_world_camera, camera.rays())
