"""Frames as tensors of the size that tracking or mapping works at, and renders of the map to compare with."""

import numpy as np
import torch
from torch import Tensor

from edslam_ti.baselines.splatam.gaussian_map import IsotropicMap
from edslam_ti.camera import Camera
from edslam_ti.depth_images import block_means, measured_means
from edslam_ti.kernels.culling import drawable
from edslam_ti.kernels.projection import LOW_PASS
from edslam_ti.kernels.rasterization import Rasterization, rasterize
from edslam_ti.mapping.gaussians import Gaussians


class Scale:
    """The camera of images averaged over blocks, and what turns frames into tensors of its size."""

    def __init__(self, camera: Camera, width: int, device: str) -> None:
        """`width`: pixels; the image is divided by the whole number that brings it nearest from above."""
        self.reduction = max(camera.width // width, 1)
        self.camera = camera if self.reduction == 1 else camera.downscaled(self.reduction)
        self.device = device

    def image(self, image: np.ndarray) -> Tensor:  # [H, W] in [0, 1] -> [h, w]
        """Return block means."""
        return self._tensor(block_means(image, self.reduction))

    def depth(self, depth: np.ndarray) -> Tensor:  # [H, W] metres, 0 = missing -> [h, w]
        """Return means of the depths in a block, 0 where they lie on no single surface."""
        finite = np.where(np.isfinite(depth) & (depth > 0), depth, 0)
        return self._tensor(measured_means(finite, self.reduction))

    def rays(self) -> Tensor:  # [h, w, 3]
        """Return the viewing rays, scaled to z = 1."""
        return self._tensor(self.camera.rays())

    def render(self, gaussians: Gaussians, T_camera_world: Tensor) -> Rasterization:
        """Return the Gaussians seen from a pose [4, 4], on black, as they look in the whole image."""
        camera = self.camera
        return rasterize(
            gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors,
            T_camera_world, camera.intrinsics, (camera.width, camera.height),
            low_pass=LOW_PASS / self.reduction**2,
        )  # fmt: skip

    def in_view(self, gaussians: IsotropicMap, T_camera_world: Tensor) -> Tensor:  # [M] indices
        """Return the Gaussians that may show from a pose [4, 4]."""
        camera, raw = self.camera, gaussians.raw
        log_scales = raw["log_scales"].expand(-1, 3)
        size = (camera.width, camera.height)
        return drawable(raw["means"], log_scales, T_camera_world, camera.intrinsics, size)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(self.device)
