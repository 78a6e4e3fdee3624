"""KISS-ICP on the points of the depth images, if the package `kiss-icp` is installed.

Vizzo et al. 2023, the authors' own code (the extra `kiss`). It is designed for lidars; the settings here are
scaled to rooms. It uses depth images only, so the poses of frames without depth are predicted.
"""

from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import MissingExtraError
from edslam_ti.frame import Frame
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.trajectory import Trajectory

MAX_RANGE, MIN_RANGE = 10.0, 0.1  # metres
VOXEL_SIZE = 0.03  # metres, of its local map
INITIAL_THRESHOLD = 0.1  # metres; initial distance within which points are matched
MIN_MOTION = 0.002  # metres; smaller motions do not change the adaptive threshold


class KissIcpTracker:
    """Registers each depth image to a local voxel map (Tracker)."""

    def __init__(self, camera: Camera) -> None:
        try:
            from kiss_icp.config import KISSConfig
            from kiss_icp.kiss_icp import KissICP
        except ModuleNotFoundError as error:
            message = "not installed: method kiss_icp needs pip install 'edslam-ti[kiss]'"
            raise MissingExtraError(message) from error
        config = KISSConfig()
        config.data.max_range, config.data.min_range, config.data.deskew = MAX_RANGE, MIN_RANGE, False
        config.mapping.voxel_size = VOXEL_SIZE
        config.adaptive_threshold.initial_threshold = INITIAL_THRESHOLD
        config.adaptive_threshold.min_motion_th = MIN_MOTION
        self._odometry: Any = KissICP(config)
        self._rays = camera.rays().reshape(-1, 3)
        self._T_world_start: np.ndarray | None = None

    def track(self, frame: Frame, T_world_camera_guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the pose of `frame`; without depth, the guess, marked as lost."""
        if frame.depth is None:
            message = "no depth image at this time: pose predicted"
            return TrackingResult(T_world_camera_guess, False, 0.0, message)
        depth = frame.depth.reshape(-1, 1)
        points = (self._rays * depth)[depth[:, 0] > 0].astype(np.float64)
        self._odometry.register_frame(points, np.zeros(len(points)))
        if self._T_world_start is None:
            self._T_world_start = T_world_camera_guess
        return TrackingResult(self._T_world_start @ np.asarray(self._odometry.last_pose), True, 1.0)

    def consistency(self, trajectory: Trajectory) -> None:
        """Return None: it does not compare its data."""
