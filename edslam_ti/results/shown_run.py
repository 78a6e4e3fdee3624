"""A finished run as a page shows it: splats, mesh or points, and its path in time."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.mapping.gaussian_ply import read_gaussian_ply
from edslam_ti.results.pictures import read_panels
from edslam_ti.results.reading import Result, load_result, read_camera_of
from edslam_ti.trajectory import Trajectory
from edslam_ti.viewer.splats import SCATTERED, Splats, pixel_sigmas

KINDS = ("splats", "mesh", "points")
MOST_SHOWN = 400_000  # splats or points
UNKNOWN_CAMERA = Camera(width=400, height=300, fx=300.0, fy=300.0, cx=199.5, cy=149.5)
HIT_ANGLE = 0.01  # radians from the ray of a click within which points are hit
HIT_DEPTH = 0.03  # share of the distance by which points count as one surface


@dataclass(frozen=True)
class ShownRun:
    """A results folder read for a page."""

    result: Result
    camera: Camera
    splats: Splats | None
    held_out: dict[float, Path] = field(default_factory=dict)  # pictures by time, seconds

    @classmethod
    def load(cls, folder: Path) -> "ShownRun":
        """Read a results folder; raises what `load_result` raises."""
        result = load_result(folder)
        try:
            camera = read_camera_of(folder)
        except DataError:
            camera = UNKNOWN_CAMERA
        splats = _splats(folder / "map.ply") if (folder / "map.ply").is_file() else None
        offset = float(result.metrics.get("time_offset_s") or 0.0)
        names = sorted((folder / "renders").glob("[0-9]*.png"))
        held_out = {int(path.stem) / 1000 + offset: path for path in names if path.stem.isdigit()}
        return cls(result, camera, splats, held_out)

    @property
    def title(self) -> str:
        """Scene, method and error."""
        return self.result.title

    @property
    def trajectory(self) -> Trajectory:
        """The estimated path."""
        return self.result.trajectory

    @property
    def truth(self) -> Trajectory | None:
        """The true path."""
        return self.result.truth

    @property
    def begin(self) -> float:
        """Stamp of the first pose, seconds."""
        return float(self.trajectory.timestamps[0])

    @property
    def duration(self) -> float:
        """Seconds from the first pose to the last."""
        return float(self.trajectory.timestamps[-1]) - self.begin

    @property
    def half_height(self) -> float:
        """Tangent of half the camera's vertical angle of view."""
        return self.camera.height / 2 / self.camera.fy

    def pose_at(self, seconds: float) -> np.ndarray:  # [4, 4]
        """Return the pose some seconds after the first one, between the poses where need be."""
        return self.trajectory.at(self.begin + float(np.clip(seconds, 0, self.duration)))

    def has(self, kind: str) -> bool:
        """Return whether there are splats, a mesh or points."""
        parts = {"splats": self.splats, "mesh": self.result.mesh, "points": self.result.points}
        return parts.get(kind) is not None

    @property
    def best(self) -> str | None:
        """The first kind that there is."""
        return next((kind for kind in KINDS if self.has(kind)), None)

    @cached_property
    def points(self) -> np.ndarray:  # [N, 3] metres
        """Points of the map, for clicks."""
        if self.splats is not None:
            return self.splats.means.astype(np.float64)
        if self.result.points is not None:
            return self.result.points
        return np.empty((0, 3)) if self.result.mesh is None else np.asarray(self.result.mesh.vertices)

    def width(self, direction: np.ndarray) -> float:  # [3], unit length
        """Return how far map and path reach in a direction, metres; a few stray points do not count."""
        path = self.trajectory.poses[:, :3, 3] @ direction
        low, high = path.min(), path.max()
        if len(self.points):
            near, far = np.percentile(self.points @ direction, (2, 98))
            low, high = min(low, near), max(high, far)
        return max(float(high - low), 0.5)

    def draw(self, kind: str, scene: Any, name: str) -> Any:
        """Add splats, mesh or points to a page's scene; return the handle."""
        result = self.result
        if kind == "splats" and self.splats is not None:
            sigmas = pixel_sigmas(self.splats.means, self.trajectory.poses, self.camera)
            return self.splats.widened(sigmas).draw(scene, name)
        if kind == "points" and result.points is not None and result.brightness is not None:
            chosen = _thinned(len(result.points))
            grey = np.repeat(np.clip(result.brightness[chosen, None], 0, 1), 3, axis=1)
            return scene.add_point_cloud(name, result.points[chosen], grey, point_size=0.006)
        from trimesh import Trimesh  # it comes with viser

        mesh = result.mesh
        if mesh is None:
            raise DataError(f"{result.folder}: no {kind} in it")
        colors = np.asarray(mesh.vertex_colors) if mesh.has_vertex_colors() else None
        vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
        shown = Trimesh(vertices, triangles, vertex_colors=colors, process=False)
        return scene.add_mesh_trimesh(name, shown)

    def panels(self, stamp: float) -> tuple[np.ndarray, np.ndarray]:  # [h, w, 3] uint8 each
        """Return truth and render at a time that mapping did not see."""
        return read_panels(self.held_out[stamp])


def first_hit(
    points: np.ndarray,  # [N, 3] metres
    origin: np.ndarray,  # [3] of the ray
    direction: np.ndarray,  # [3]
) -> np.ndarray | None:  # [3]
    """Return the point of the first surface along a ray that is nearest to the ray; None: none is near."""
    direction = direction / np.linalg.norm(direction)
    along = (points - origin) @ direction
    beside = np.linalg.norm(points - origin - along[:, None] * direction, axis=1)
    is_hit = (along > 0) & (beside < HIT_ANGLE * along)
    if not is_hit.any():
        return None
    is_front = is_hit & (along < (1 + HIT_DEPTH) * along[is_hit].min())
    candidates = np.flatnonzero(is_front)
    return np.asarray(points[candidates[beside[candidates].argmin()]])


def _splats(path: Path) -> Splats:
    gaussians = read_gaussian_ply(path)
    chosen = _thinned(len(gaussians["means"]))
    size = np.float32(max(1.0, len(gaussians["means"]) / max(len(chosen), 1)) ** 0.5)
    return Splats(
        gaussians["means"][chosen],
        gaussians["quats"][chosen],
        size * np.exp(gaussians["log_scales"][chosen]),
        1 / (1 + np.exp(-gaussians["logit_opacities"][chosen])),
        gaussians["colors"][chosen],
    )


def _thinned(count: int) -> np.ndarray:  # [at most about MOST_SHOWN] indices
    """Return indices spread evenly, all of them where there are few."""
    everyone = np.arange(count)
    if count <= MOST_SHOWN:
        return everyone
    return everyone[everyone * SCATTERED % 2**32 < 2**32 * MOST_SHOWN / count]
