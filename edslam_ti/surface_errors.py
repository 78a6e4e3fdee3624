"""A reconstructed mesh against the true surfaces: accuracy and completion (Zhu et al. 2022, NICE-SLAM)."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets import EventDepthSequence
from edslam_ti.errors import DataError
from edslam_ti.evaluation import align_views
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.trajectory import Trajectory

NUM_SAMPLES = 100_000  # points drawn on a reconstructed mesh
SPACING = 0.02  # metres; one true point is kept of those that fall into a cube of this size
COMPLETE_WITHIN = 0.05  # metres
VIEW_STEP, VIEW_TURN = 0.1, 5.0  # metres, degrees between the views that say what was seen


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
    seen = surfaces.seen_points(sequence.camera, [*truth.spread(VIEW_STEP, VIEW_TURN), *beside])
    return surfaces.errors(mesh, seen, align_views(estimate.resampled(truth.timestamps).poses, truth.poses))


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
