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
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.trajectory import Trajectory

NUM_SAMPLES = 100_000  # points drawn on a reconstructed mesh
SPACING = 0.02  # metres; one true point is kept of those that fall into a cube of this size
COMPLETE_WITHIN = 0.05  # metres
OCCLUSION = 0.03  # metres, or this share of the depth, by which a surface may lie behind what is in front
VIEW_STEP, VIEW_TURN = 0.1, 5.0  # metres, degrees between the views that say what was seen


@dataclass(frozen=True)
class SurfaceErrors:
    """How far two surfaces are apart."""

    accuracy_cm: float  # mean distance of the mesh from the true surfaces
    completion_cm: float  # mean distance of the true points that a camera saw from the mesh
    completion_ratio: float  # share of those points with the mesh within 5 cm


@dataclass(frozen=True)
class Look:
    """Depth seen by one camera."""

    camera: Camera
    T_world_camera: np.ndarray  # [4, 4]
    depth: np.ndarray  # [H, W] metres, 0 = nothing


class TrueSurfaces:
    """The triangles of a scene."""

    def __init__(self, path: Path) -> None:
        self._scene = _ray_casting(read_triangles(path))

    def depth(self, camera: Camera, T_world_camera: np.ndarray) -> np.ndarray:  # [H, W] metres, 0 = nothing
        """Return the depth seen from a pose."""
        o3d = load_open3d()
        directions = camera.rays() @ T_world_camera[:3, :3].T  # [H, W, 3] with z = 1: t is the depth
        origins = np.broadcast_to(T_world_camera[:3, 3], directions.shape)
        rays = np.concatenate([origins, directions], -1).astype(np.float32)
        distance = self._scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        return np.where(np.isfinite(distance), distance, 0).astype(np.float32)

    def looks(self, camera: Camera, poses: Iterable[np.ndarray]) -> "list[Look]":
        """Return what cameras at these poses [4, 4] see, at half the size."""
        small = camera.downscaled(2)
        return [Look(small, T, self.depth(small, T)) for T in poses]

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


def mesh_errors(mesh: Any, sequence: EventDepthSequence, estimate: Trajectory) -> SurfaceErrors:
    """Compare a mesh in the frame of an estimated path with what the sequence's camera saw on the way.

    Seen is what lies in a view of the true path at the estimate's times, or of those beside it.
    """
    if sequence.surfaces_file is None or sequence.truth is None:
        raise DataError(
            f"{sequence.scene}: expected surfaces.ply and true poses to compare a mesh with; simulated "
            "recordings have both"
        )
    inside = [t for t in estimate.timestamps if sequence.truth.covers(t)]
    if not inside:
        raise DataError(f"{sequence.scene}: the estimate has no pose at a time that the truth covers")
    truth = sequence.truth.resampled(np.array(inside))
    beside = [v.T_world_camera for v in sequence.novel_views() if inside[0] <= v.timestamp <= inside[-1]]
    surfaces = TrueSurfaces(sequence.surfaces_file)
    seen = seen_points(surfaces.looks(sequence.camera, [*lookouts(truth), *beside]))
    return surfaces.errors(mesh, seen, align_views(estimate.resampled(truth.timestamps).poses, truth.poses))


def seen_points(looks: Iterable[Look]) -> np.ndarray:  # [N, 3] float32 metres, world
    """Return points evenly spread over all that was seen."""
    kept = [np.empty((0, 3), np.float32)]
    kept += [_back_projected(a.depth, a.camera, a.T_world_camera).astype(np.float32) for a in looks]
    points = np.concatenate(kept)
    _, first = np.unique(np.floor(points / SPACING).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]


def seen_pixels(
    camera: Camera,
    depth: np.ndarray,  # [H, W] metres of a view, 0 = missing
    T_world_camera: np.ndarray,  # [4, 4] of that view
    looks: Iterable[Look],
) -> np.ndarray:  # [H, W] bool
    """Return the pixels of a view whose surface is visible in one of the looks, too."""
    points = _back_projected(depth, camera, T_world_camera)
    seen = np.zeros(len(points), bool)

    def distance(look: Look) -> float:
        return float(np.linalg.norm(look.T_world_camera - T_world_camera))

    for look in sorted(looks, key=distance):  # the nearest see most: little is left for the others
        left = np.flatnonzero(~seen)
        if len(left) == 0:
            break
        T_camera_world, seer = np.linalg.inv(look.T_world_camera), look.camera
        p = points[left] @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        z = np.maximum(p[:, 2], 1e-6)
        u = np.rint(seer.fx * p[:, 0] / z + seer.cx)
        v = np.rint(seer.fy * p[:, 1] / z + seer.cy)
        inside = (p[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < seer.width) & (v < seer.height)
        front = look.depth[v[inside].astype(int), u[inside].astype(int)]
        seen[left[inside]] = z[inside] < front + np.maximum(OCCLUSION, OCCLUSION * front)
    result = np.zeros(depth.shape, bool)
    result[depth > 0] = seen
    return result


def lookouts(path: Trajectory) -> list[np.ndarray]:  # [4, 4] each
    """Return poses of a path from which all is seen that the path sees."""
    return path.spread(VIEW_STEP, VIEW_TURN)


def read_triangles(path: Path) -> Any:
    """Return the Open3D TriangleMesh in a file."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: mesh not found")
    mesh = load_open3d().io.read_triangle_mesh(str(path))
    if len(mesh.triangles) == 0:
        raise DataError(f"{path}: expected a mesh, could not read any triangle")
    return mesh


def _back_projected(depth: np.ndarray, camera: Camera, T: np.ndarray) -> np.ndarray:  # [N, 3] metres, world
    known = depth > 0
    return depth[known][:, None] * camera.rays()[known] @ T[:3, :3].T + T[:3, 3]


def _ray_casting(mesh: Any) -> Any:
    o3d = load_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    return scene
