"""Depth of one camera as another camera would have measured it."""

import numpy as np

from edslam_ti.camera import NEAREST, Camera
from edslam_ti.kernels.depth_drawing import draw_depth
from edslam_ti.lenses import Lens

# Neighbouring depths that differ by less than this share lie on one surface. A floor seen from 1 m above at
# 4 m has steps of 1 % in a Kinect's image. At 3 m, a step of this size moves by a third of a pixel between
# cameras 10 cm apart.
SURFACE_STEP = 0.04


class DepthReprojection:
    """Draws depth images of a camera with a lens into a pinhole camera beside it.

    Pixels that the depth camera did not see are missing, and so are those next to a nearer surface. The
    kernels must have been started.
    """

    def __init__(
        self,
        lens: Lens,  # of the depth camera
        camera: Camera,  # undistorted, that receives depth
        T_camera_depth: np.ndarray,  # [4, 4]
    ) -> None:
        self.camera = camera
        self._rays = lens.rays
        self._T_camera_depth = np.array(T_camera_depth, np.float64)

    def __call__(self, depth: np.ndarray) -> np.ndarray:  # [h, w] m -> [H, W] float32 m, 0 = missing
        """Return one depth image."""
        camera = self.camera
        return draw_depth(
            depth,
            self._rays,
            self._T_camera_depth,
            camera.intrinsics,
            camera.shape,
            NEAREST,
            SURFACE_STEP,
        )
