"""Generalised ICP of the depth images (the package `small_gicp`, the extra `gicp`), from keyframe to frame.

Segal et al. 2009, in the package of Koide (2024). The keyframes are ours, as those of `open3d_icp`. It uses
depth images only, so the poses of frames without depth are predicted.
"""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import MissingExtraError
from edslam_ti.frame import Frame
from edslam_ti.geometry import inverse, is_near, orthonormalized
from edslam_ti.rgbd_config import SmallGicpConfig
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.trajectory import Trajectory

MIN_POINTS = 50  # fewer points determine no pose
ROTATION_EPSILON, TRANSLATION_EPSILON = 1e-5, 1e-5  # radians, metres; smaller steps end the alignment


@dataclass(frozen=True)
class PointSet:
    """Points of one depth image, and what the package makes of them on first use."""

    points: np.ndarray  # [N, 3] float64 metres, camera frame
    voxel_size: float  # metres
    num_neighbours: int

    @functools.cached_property
    def prepared(self) -> tuple[Any, Any]:
        """The package's cloud, averaged in cells and with a covariance a point, and its search tree."""
        # One thread: with more, the order of points differs from run to run.
        cloud, tree = _package().preprocess_points(self.points, self.voxel_size, self.num_neighbours, 1)
        return cloud, tree


@dataclass(frozen=True)
class Reference:
    """The keyframe that frames are aligned to."""

    points: PointSet
    T_world_camera: np.ndarray  # [4, 4]


class SmallGicpTracker:
    """Aligns each depth image to that of a keyframe by generalised ICP (Tracker)."""

    def __init__(self, camera: Camera, config: SmallGicpConfig) -> None:
        """Raise MissingExtraError where the package is not installed."""
        _package()
        self._rays = camera.rays()
        self._config = config
        self._reference: Reference | None = None

    def track(self, frame: Frame, T_world_camera_guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the pose of `frame`; without depth, the guess, marked as lost."""
        points = None if frame.depth is None else self._points(frame.depth)
        if points is None or points.prepared[0].size() < MIN_POINTS:
            message = "no depth image at this time: pose predicted"
            if points is not None:
                message = f"depth at only {len(points.points)} pixels: pose predicted"
            return TrackingResult(T_world_camera_guess, False, 0.0, message)
        if self._reference is None:
            self._reference = Reference(points, T_world_camera_guess)
            return TrackingResult(T_world_camera_guess, True, 1.0)
        config, T_world_reference = self._config, self._reference.T_world_camera
        T_reference_camera, overlap = self._aligned(
            points, self._reference.points, inverse(T_world_reference) @ T_world_camera_guess
        )
        converged = overlap >= config.min_overlap
        pose = orthonormalized(T_world_reference @ T_reference_camera) if converged else T_world_camera_guess
        is_close = is_near(T_reference_camera, config.reference_distance, config.reference_angle)
        if not converged or not is_close:
            self._reference = Reference(points, pose)
        message = "" if converged else f"only {overlap:.0%} of points found a partner: pose predicted"
        return TrackingResult(pose, converged, overlap, message)

    def consistency(self, trajectory: Trajectory) -> None:
        """Return None: it does not compare its data."""

    def _points(self, depth: np.ndarray) -> PointSet:  # [H, W] metres, 0 = missing
        usable = (depth > 0) & (depth < self._config.max_depth)
        points = (self._rays[usable] * depth[usable][:, None]).astype(np.float64)
        return PointSet(points, self._config.voxel_size, self._config.num_neighbours)

    def _aligned(
        self, points: PointSet, reference: PointSet, T_guess: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Return T_reference_camera and the share of points that have a partner in the reference."""
        cloud, (target, tree) = points.prepared[0], reference.prepared
        result = _package().align(
            target,
            cloud,
            tree,
            T_guess,
            registration_type="GICP",
            max_correspondence_distance=self._config.max_distance,
            num_threads=1,
            max_iterations=self._config.iterations,
            rotation_epsilon=ROTATION_EPSILON,
            translation_epsilon=TRANSLATION_EPSILON,
        )
        T = np.asarray(result.T_target_source)
        return (T, result.num_inliers / cloud.size()) if np.isfinite(T).all() else (T_guess, 0.0)


def _package() -> Any:
    """Return the package, which is loaded on first use."""
    try:
        import small_gicp
    except ModuleNotFoundError as error:
        message = "not installed: method small_gicp needs pip install 'edslam-ti[gicp]'"
        raise MissingExtraError(message) from error
    return small_gicp
