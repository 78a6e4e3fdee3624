"""Frames without depth aligned to the map: the Gauss-Newton half of bundle adjustment by turns.

Between depth images the tracker has one keyframe's brightness and a motion prior to go by. The map has seen
the same surfaces in all frames: its errors are as large, but others, so that half way between is better
than either. Where a frame has depth, the tracker is the better of the two.
"""

from dataclasses import replace

import numpy as np

from edslam_ti.alignment import MIN_PIXELS, is_observed, levenberg_marquardt, linearised, residual_model
from edslam_ti.camera import Camera
from edslam_ti.config import TrackingConfig
from edslam_ti.geometry import is_near, se3_exp, se3_log
from edslam_ti.kernels.patch_warp import Patches

OPAQUE = 0.9  # alpha from which a pixel of the map's view is a surface
SPACING = 2  # pixels between those that are aligned, in either direction
STEPS = 3  # of Levenberg-Marquardt: the pose is nearly right
FARTHEST = (0.02, 2.0)  # metres, degrees: a larger correction is not believed
SHARE = 0.5  # of a correction that is made: the tracker's errors and the map's are as large, and independent


class MapAligner:
    """Corrects poses by comparing images with what the map shows there."""

    def __init__(self, camera: Camera, config: TrackingConfig) -> None:
        self._camera = camera
        self._model = replace(residual_model(config, config.brightness_sigma), depth_weight=0.0)

    def corrected(
        self,
        image: np.ndarray,  # [H, W] log brightness
        view: np.ndarray,  # [H, W] log brightness of the map, seen from the pose as it is
        depth: np.ndarray,  # [H, W] metres, of that view
        alpha: np.ndarray,  # [H, W] of that view
        T_world_camera: np.ndarray,  # [4, 4]
    ) -> np.ndarray:  # [4, 4]
        """Return the pose half way to where the map looks like the image; as it is where that is in doubt."""
        v, u = SPACING * np.stack(np.nonzero((alpha > OPAQUE)[::SPACING, ::SPACING]))
        if len(v) < MIN_PIXELS:
            return T_world_camera
        image = image - np.median(image[v, u] - view[v, u])  # their levels may differ
        pixels = np.stack([u, v, 1 / depth[v, u]], -1).astype(np.float32)
        points = Patches(pixels, view[v, u]).points(self._camera.intrinsics)
        no_depth = np.zeros(image.shape, np.float32)
        linearise = linearised(points, self._model, [image.astype(np.float32), no_depth], self._camera)
        T_view_camera, system = levenberg_marquardt(linearise, np.eye(4), STEPS)
        is_good = is_observed(system) and is_near(T_view_camera, *FARTHEST)
        return T_world_camera @ se3_exp(SHARE * se3_log(T_view_camera)) if is_good else T_world_camera
