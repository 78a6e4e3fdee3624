"""Loss of the map: brightness, depth and the shape of Gaussians (Eq. 12, 14, 15, 16).

The paper compares two renders with the change of brightness measured between them (Eq. 10 to 12). Here the
image at the start of that change is known (event_images/solve.py), so one render is compared with that image
plus the change. This is the same residual with the first view replaced by a known image.
"""

from dataclasses import dataclass

import numpy as np
from torch import Tensor, zeros_like

from edslam_ti.camera import Camera
from edslam_ti.config import MappingConfig
from edslam_ti.geometry import inverse
from edslam_ti.kernels.view_losses import Comparison, compare_view
from edslam_ti.mapping.gaussians import GaussianMap, Gaussians

# Squared log brightness by which the mean square of Eq. 12 is divided, so that the event loss of a map of
# uniform brightness is of the order of 1. At lambda_event = 1 the mean square itself has weight 10.
BRIGHTNESS_VARIANCE = 0.1


@dataclass(frozen=True)
class MapLoss:
    """Eq. 16 for one view."""

    total: Tensor  # differentiable in the map and the pose
    event: float  # Eq. 12 divided by BRIGHTNESS_VARIANCE, unweighted
    difference: np.ndarray  # [H, W] log brightness of the map minus that of the image


def map_loss(
    gaussians: GaussianMap,
    camera: Camera,
    T_world_camera: Tensor,  # [4, 4]
    log_brightness: Tensor,  # [H, W] log(brightness + epsilon)
    depth: Tensor | None,  # [H, W] metres, 0 = missing
    config: MappingConfig,
) -> MapLoss:
    """Return Eq. 16: lambda_event Eq. 12 / variance + lambda_d Eq. 15 + lambda_reg Eq. 14."""
    view = view_loss(
        gaussians.activated(), camera, T_world_camera, log_brightness, depth,
        config.background, config.log_epsilon,
        (config.event_weight / BRIGHTNESS_VARIANCE, config.depth_weight),
    )  # fmt: skip
    total = view.loss
    if config.scale_weight > 0:
        log_scales = gaussians.raw["log_scales"]
        total = total + config.scale_weight * scale_loss(log_scales, config.max_scale_ratio)
    event = float(view.difference.square().mean()) / BRIGHTNESS_VARIANCE
    return MapLoss(total, event, view.difference.numpy())


def view_loss(
    gaussians: Gaussians,
    camera: Camera,
    T_world_camera: Tensor,  # [4, 4]
    log_brightness: Tensor,  # [H, W] log(brightness + epsilon)
    depth: Tensor | None,  # [H, W] metres, 0 = missing
    background: float,  # brightness behind everything
    epsilon: float,
    weights: tuple[float, float],  # of Eq. 12 and of Eq. 15
) -> Comparison:
    """Return a view's brightness loss (Eq. 12) and depth loss (Eq. 15), with gradients in one pass.

    Eq. 12 is the mean over all pixels of the squared difference of log brightness. Eq. 15 is the mean over
    pixels with depth of |rendered - alpha * measured|, because rendered depth is weighted by alpha (Eq. 8).
    With |rendered - measured|, 1 % of transparency at 3 m would count as 3 cm and pull every surface back.
    """
    if depth is None or weights[1] == 0:
        depth = zeros_like(log_brightness)
    num_measured = max(int((depth > 0).sum()), 1)
    return compare_view(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors,
        inverse(T_world_camera).float(), camera.intrinsics, (camera.width, camera.height),
        log_brightness, depth, background, epsilon,
        weights[0] / log_brightness.numel(), weights[1] / num_measured,
    )  # fmt: skip


def scale_loss(
    log_scales: Tensor,  # [G, 3]
    max_ratio: float,  # r
) -> Tensor:
    """Return by how much, on average, the length of Gaussians exceeds r times their thickness, Eq. 14."""
    ratio = (log_scales.amax(-1) - log_scales.amin(-1)).exp()
    return (ratio.clamp_min(max_ratio) - max_ratio).mean()
