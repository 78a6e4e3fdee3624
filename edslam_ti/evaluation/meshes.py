"""A reconstructed mesh against the true surfaces: accuracy and completion (Zhu et al. 2022, NICE-SLAM)."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets import EventDepthSequence
from edslam_ti.errors import DataError
from edslam_ti.evaluation.trajectories import align_views
from edslam_ti.mesh_reading import read_triangle_mesh
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.ray_casting import RayCaster, pixel_rays
from edslam_ti.trajectory import Trajectory
from edslam_ti.truth import true_poses_at

NUM_SAMPLES = 100_000  # points drawn on a reconstructed mesh
SPACING = 0.02  # metres; one true point is kept per cube of this size
COMPLETE_WITHIN = 0.05  # metres
OCCLUSION = 0.03  # metres, or share of the depth: a point farther behind the visible surface is occluded
VIEW_STEP, VIEW_TURN = 0.1, 5.0  # metres, degrees between the views that determine which surfaces were seen


@dataclass(frozen=True)
class SurfaceErrors:
    """Distances between a mesh and the true surfaces."""

    accuracy_cm: float  # mean distance of the mesh from the true surfaces
    completion_cm: float  # mean distance of the true points that a camera saw from the mesh
    completion_ratio: float  # share of those points with the mesh within 5 cm


@dataclass(frozen=True)
class DepthView:
    """Depth seen by one camera."""

    camera: Camera
    T_world_camera: np.ndarray  # [4, 4]
    depth: np.ndarray  # [H, W] metres, 0 = nothing


class TrueSurfaces:
    """The triangles of a scene."""

    def __init__(self, path: Path) -> None:
        """Read a mesh file; raise FileNotFoundError or DataError where there is none."""
        self._caster = RayCaster.of_mesh(read_triangle_mesh(path))

    def depth(self, camera: Camera, T_world_camera: np.ndarray) -> np.ndarray:  # [H, W] metres, 0 = nothing
        """Return the depth seen from a pose."""
        return self._caster.cast(pixel_rays(camera, T_world_camera)).depth

    def views(self, camera: Camera, poses: Iterable[np.ndarray]) -> list[DepthView]:
        """Return the depth that cameras at these poses [4, 4] see, at half the size."""
        small = camera.downscaled(2)
        return [DepthView(small, T, self.depth(small, T)) for T in poses]

    def errors(
        self,
        mesh: Any,  # Open3D TriangleMesh
        seen: np.ndarray,  # [N, 3] metres
        T_world_estimate: np.ndarray,  # [4, 4], from the mesh's frame to that of the surfaces
        seed: int = 0,
    ) -> SurfaceErrors:
        """Compare a mesh with the surfaces; raise DataError if the mesh or `seen` is empty."""
        if len(mesh.triangles) == 0 or len(seen) == 0:
            raise DataError(
                f"mesh errors: expected triangles and points that a camera saw, got {len(mesh.triangles)} "
                f"triangles and {len(seen)} points"
            )
        o3d = load_open3d()
        o3d.utility.random.seed(seed)
        moved = o3d.geometry.TriangleMesh(mesh).transform(T_world_estimate)
        drawn = np.asarray(moved.sample_points_uniformly(NUM_SAMPLES).points, np.float32)
        to_truth = self._caster.distances_to(drawn)
        to_mesh = RayCaster.of_mesh(moved).distances_to(seen)
        return SurfaceErrors(
            100 * float(to_truth.mean()),
            100 * float(to_mesh.mean()),
            float((to_mesh <= COMPLETE_WITHIN).mean()),
        )


def mesh_errors(mesh: Any, sequence: EventDepthSequence, estimate: Trajectory) -> SurfaceErrors:
    """Compare a mesh in the frame of an estimated path with the surfaces that the sequence's camera saw.

    A surface counts as seen if a view from the true path at the estimate's times shows it, or a novel view.
    """
    if sequence.surfaces_file is None or sequence.truth is None:
        raise DataError(
            f"{sequence.scene}: expected surfaces.ply and true poses to compare a mesh with; simulated "
            "recordings have both"
        )
    poses, is_known = true_poses_at(sequence.truth, estimate.timestamps)
    inside = estimate.timestamps[is_known]
    if len(inside) == 0:
        raise DataError(f"{sequence.scene}: the estimate has no pose at a time that the truth covers")
    truth = Trajectory(inside, poses[is_known])
    novel = [v.T_world_camera for v in sequence.novel_views() if inside[0] <= v.timestamp <= inside[-1]]
    surfaces = TrueSurfaces(sequence.surfaces_file)
    seen = seen_points(surfaces.views(sequence.camera, [*viewpoints(truth), *novel]))
    return surfaces.errors(mesh, seen, align_views(estimate.resampled(truth.timestamps).poses, truth.poses))


def seen_points(views: Iterable[DepthView]) -> np.ndarray:  # [N, 3] float32 metres, world
    """Return evenly distributed points on all surfaces that were seen."""
    parts = [np.empty((0, 3), np.float32)]
    parts += [_world_points(v.depth, v.camera, v.T_world_camera).astype(np.float32) for v in views]
    points = np.concatenate(parts)
    _, first = np.unique(np.floor(points / SPACING).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]


def seen_pixels(
    camera: Camera,
    depth: np.ndarray,  # [H, W] metres of a view, 0 = missing
    T_world_camera: np.ndarray,  # [4, 4] of that view
    views: Iterable[DepthView],
) -> np.ndarray:  # [H, W] bool
    """Return the pixels of a view whose surface is also visible in one of the views."""
    points = _world_points(depth, camera, T_world_camera)
    seen = np.zeros(len(points), bool)

    def distance(view: DepthView) -> float:
        return float(np.linalg.norm(view.T_world_camera - T_world_camera))

    for view in sorted(views, key=distance):  # the nearest see most, so few pixels remain for the others
        left = np.flatnonzero(~seen)
        if len(left) == 0:
            break
        T_camera_world = np.linalg.inv(view.T_world_camera)
        u, v, z = view.camera.project(points[left] @ T_camera_world[:3, :3].T + T_camera_world[:3, 3])
        u, v = np.rint(u), np.rint(v)
        inside = (z > 0) & (u >= 0) & (v >= 0) & (u < view.camera.width) & (v < view.camera.height)
        front = view.depth[v[inside].astype(int), u[inside].astype(int)]
        seen[left[inside]] = z[inside] < front + np.maximum(OCCLUSION, OCCLUSION * front)
    result = np.zeros(depth.shape, bool)
    result[depth > 0] = seen
    return result


def viewpoints(path: Trajectory) -> list[np.ndarray]:  # [4, 4] each
    """Return a subset of a path's poses that together see everything the path sees."""
    return path.spread(VIEW_STEP, VIEW_TURN)


def _world_points(depth: np.ndarray, camera: Camera, T: np.ndarray) -> np.ndarray:  # [N, 3] metres, world
    return camera.back_project(depth) @ T[:3, :3].T + T[:3, 3]
