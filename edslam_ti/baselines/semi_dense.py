"""A semi-dense map: the edges that events show, at measured depth, one point per voxel."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edslam_ti.baselines.depth_event_vo import semi_dense_pixels
from edslam_ti.camera import NEAREST, Camera
from edslam_ti.config import DepthEventVoConfig, TimeSurfaceConfig
from edslam_ti.frame import Frame
from edslam_ti.geometry import inverse, transformed
from edslam_ti.mapping.mapper import Progress
from edslam_ti.mapping.rendering import View
from edslam_ti.tracking.surfaces import SurfaceFrameBuilder
from edslam_ti.trajectory import Trajectory

EDGE, PAPER = 0.0, 1.0  # brightness of points and of what is behind: events alone do not give it


class SemiDenseMapper:
    """Collects the edges of all frames with depth (Mapper).

    The points of a voxel are the first one seen there, so the map grows with the scene, not with time.
    """

    num_gaussians = 0
    loss = float("nan")

    def __init__(
        self, camera: Camera, surface_config: TimeSurfaceConfig, config: DepthEventVoConfig, seed: int
    ) -> None:
        self._camera = camera
        self._config = config
        self._surfaces = SurfaceFrameBuilder(camera, surface_config)
        self._random = np.random.default_rng(seed + 1)
        self._points = np.zeros((0, 3), np.float32)  # metres, world
        self._voxels = np.zeros(0, np.int64)  # sorted keys of voxels that hold a point

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Add the newest frame's edges where there is no point yet."""
        level = self._surfaces.build(frame).level(0)
        if frame.depth is None or frame.is_held_out:
            return
        config = self._config
        rows, columns = semi_dense_pixels(
            level.surface, frame.depth, config.min_time_surface, config.num_points, self._random
        )
        seen = self._camera.back_project_pixels(columns, rows, frame.depth[rows, columns])
        points = transformed(trajectory.pose(-1), seen).astype(np.float32)
        keys, first = np.unique(self._keys(points), return_index=True)
        is_new = ~np.isin(keys, self._voxels, assume_unique=True)
        self._points = np.concatenate([self._points, points[first[is_new]]])
        self._voxels = np.union1d(self._voxels, keys[is_new])

    def _keys(self, points: np.ndarray) -> np.ndarray:  # [N, 3] -> [N] int64
        """Return a number for the voxel of each point, 21 bits a coordinate."""
        x, y, z = (
            np.floor(points.astype(np.float64) / self._config.voxel_size).astype(np.int64) & 0x1FFFFF
        ).T
        return x << 42 | y << 21 | z

    def forget_depth(self, frames: Sequence[int], trajectory: Trajectory) -> None:
        """Leave the points as they are: its tracker trusts all depth."""

    def finish(self, trajectory: Trajectory, progress: Progress) -> None:
        """Do nothing: there is nothing to refine."""
        progress(1.0)

    def render(self, camera: Camera, T_world_camera: np.ndarray, measured_only: bool = False) -> View:
        """Return the points seen from a pose, dark on bright, a pixel each; points are not occluded."""
        x, y, z = camera.project(transformed(inverse(T_world_camera), self._points), NEAREST)
        column, row = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
        shown = (z > NEAREST) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        depth = np.full(camera.shape, np.inf, np.float32)
        np.minimum.at(depth, (row[shown], column[shown]), z[shown].astype(np.float32))
        is_drawn = np.isfinite(depth)
        alpha = is_drawn.astype(np.float32)
        intensity = np.where(is_drawn, np.float32(EDGE), np.float32(PAPER))
        return View(intensity, np.where(is_drawn, depth, np.float32(0)), alpha)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the points [N, 3] and their brightness [N]: that of an edge."""
        return self._points, np.full(len(self._points), EDGE)

    @property
    def map(self) -> np.ndarray:  # [N, 3] metres, world
        """The points."""
        return self._points

    def keyframe_indices(self) -> list[int]:
        """Return an empty list: every frame with depth adds its edges."""
        return []

    def metrics(self) -> dict[str, int | float | None]:
        """Return the number of points."""
        return {"num_points": len(self._points)}

    def save(self, folder: Path) -> None:
        """Write nothing: points are written for every mapper."""
