"""Truncated signed distances fused from depth images, their mesh, and views of a mesh (Open3D, CPU)."""

from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.ray_casting import RayCaster, pixel_rays

BLOCK = 8  # voxels along the side of one hashed block
TRUNCATION_VOXELS = 4.0  # distances are kept up to this many voxels from the surface
FIRST_CAPACITY = 4000  # blocks, 10 kB each; Open3D grows the table by itself


class TsdfVolume:
    """A signed distance volume with brightness (Curless and Levoy 1996) in hashed blocks of voxels."""

    def __init__(self, camera: Camera, voxel_size: float, max_depth: float = 10.0) -> None:
        """Start empty; `voxel_size` and `max_depth` (farther depth is left out) are in metres."""
        if not voxel_size > 0:
            raise DataError(f"voxel_size: expected a positive length in metres, got {voxel_size}")
        o3d = load_open3d()
        self.camera = camera
        self.max_depth = max_depth
        self.num_frames = 0
        K = camera.matrix
        self._pixel_rays = o3d.core.Tensor(K)
        # Integration looks up pixel floor(K p): half a pixel more makes that the nearest centre.
        self._pixel_lookup = o3d.core.Tensor(K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(o3d.core.float32,) * 3,
            attr_channels=((1), (1), (3)),
            voxel_size=voxel_size,
            block_resolution=BLOCK,
            block_count=FIRST_CAPACITY,
            device=o3d.core.Device("CPU:0"),
        )

    def integrate(
        self,
        depth: np.ndarray,  # [H, W] metres, 0 = missing
        brightness: np.ndarray,  # [H, W] in [0, 1]
        T_world_camera: np.ndarray,  # [4, 4]
    ) -> None:
        """Fuse one view."""
        for name, image in (("depth", depth), ("brightness", brightness)):
            if image.shape != self.camera.shape:
                raise DataError(f"{name}: expected shape {self.camera.shape}, got {image.shape}")
        o3d = load_open3d()
        # Comparisons with NaN are false: such pixels count as missing.
        usable = (depth > 0) & (depth < self.max_depth)
        if not usable.any():
            return
        depth_image = o3d.t.geometry.Image(np.ascontiguousarray(np.where(usable, depth, 0), np.float32))
        grey = np.repeat(np.clip(brightness, 0, 1)[..., None], 3, axis=-1)  # [H, W, 3]
        color_image = o3d.t.geometry.Image(np.ascontiguousarray(grey, np.float32))
        T_camera_world = o3d.core.Tensor(np.linalg.inv(T_world_camera))
        limits = {
            "depth_scale": 1.0,
            "depth_max": self.max_depth,
            "trunc_voxel_multiplier": TRUNCATION_VOXELS,
        }
        try:
            blocks = self._grid.compute_unique_block_coordinates(
                depth_image, self._pixel_rays, T_camera_world, **limits
            )
        except RuntimeError as error:  # Open3D samples every fourth pixel; none of them has depth
            if "No block is touched" not in str(error):
                raise
            return
        lookup = self._pixel_lookup
        self._grid.integrate(blocks, depth_image, color_image, lookup, lookup, T_camera_world, **limits)
        self.num_frames += 1

    def mesh(self, min_weight: float = 1.0) -> Any:
        """Return the zero surface where at least `min_weight` views agree, as an Open3D TriangleMesh.

        It may be empty. All three channels of the vertex colours hold the brightness.
        """
        o3d = load_open3d()
        if self.num_frames == 0:
            return o3d.geometry.TriangleMesh()
        # Open3D keeps voxels whose weight exceeds the threshold.
        return self._grid.extract_triangle_mesh(min_weight - 0.5).to_legacy()


class MeshView:
    """Views of an Open3D TriangleMesh by ray casting, which needs neither display nor OpenGL."""

    def __init__(self, mesh: Any) -> None:
        self._triangles = np.asarray(mesh.triangles)  # [T, 3]
        self._brightness = np.asarray(mesh.vertex_colors).reshape(-1, 3).mean(1)  # [V]
        self._caster = RayCaster.of_mesh(mesh)

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return brightness and depth [H, W] (metres, 0 = no surface) seen from a pose."""
        hits = self._caster.cast(pixel_rays(camera, T_world_camera))
        brightness = np.zeros(camera.shape, np.float32)
        if len(self._brightness):
            seen = np.isfinite(hits.distance)
            corners = self._triangles[hits.triangle[seen]]  # [N, 3]
            u, v = hits.uv[seen].T
            weights = np.stack([1 - u - v, u, v], -1)  # [N, 3]
            brightness[seen] = (self._brightness[corners] * weights).sum(-1)
        return brightness, hits.depth
