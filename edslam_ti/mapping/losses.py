"""What the map is optimised for: events, depth and the shape of its Gaussians (Eq. 10-12, 14-16)."""

import torch
from torch import Tensor

from edslam_ti.camera import Camera
from edslam_ti.geometry import inverse
from edslam_ti.kernels.view_losses import Comparison, compare_view
from edslam_ti.mapping.gaussians import Gaussians


def brightness_change(
    intensity_start: Tensor,  # [H, W]
    intensity_end: Tensor,  # [H, W]
    epsilon: float,
) -> Tensor:  # [H, W]
    """Return the synthesised log-brightness change, Eq. 10."""
    return torch.log(intensity_end + epsilon) - torch.log(intensity_start + epsilon)


def event_loss(
    predicted: Tensor,  # [H, W] Eq. 10
    measured: Tensor,  # [H, W] Eq. 11
) -> Tensor:
    """Return Eq. 12 squared and divided by the measured mean square.

    The raw loss grows with motion and interval length; divided, every interval weighs alike.
    """
    floor = 1e-3  # an interval without events must not divide by zero
    return (predicted - measured).square().mean() / (measured.square().mean() + floor)


def view_loss(
    gaussians: Gaussians,
    camera: Camera,
    T_world_camera: Tensor,  # [4, 4]
    log_brightness: Tensor,  # [H, W] log(brightness + epsilon)
    depth: Tensor | None,  # [H, W] metres, 0 = missing
    background: float,  # brightness behind everything
    epsilon: float,
    weights: tuple[float, float],  # of the mean square of the first, and of `depth_loss`
) -> Comparison:
    """Return how much a view differs in brightness and depth, with all gradients in one pass."""
    if depth is None or weights[1] == 0:
        depth = torch.zeros_like(log_brightness)
    num_measured = max(int((depth > 0).sum()), 1)
    return compare_view(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors,
        inverse(T_world_camera).float(), camera.intrinsics, (camera.width, camera.height),
        log_brightness, depth, background, epsilon,
        weights[0] / log_brightness.numel(), weights[1] / num_measured,
    )  # fmt: skip


def depth_loss(
    rendered: Tensor,  # [H, W] metres, weighted by alpha (Eq. 8)
    alpha: Tensor,  # [H, W]
    measured: Tensor,  # [H, W] metres, 0 = missing
) -> Tensor:
    """Return the mean absolute depth error over measured pixels, metres, Eq. 15, weighted by alpha.

    Not |rendered - measured|: 1 % of transparency, 3 m away, would count as 3 cm and pull every surface back.
    """
    valid = measured > 0
    return (rendered - alpha * measured).abs()[valid].mean() if bool(valid.any()) else rendered.sum() * 0


def scale_loss(
    log_scales: Tensor,  # [G, 3]
    max_ratio: float,  # r
) -> Tensor:
    """Return how much longer than r times their thickness Gaussians are on average, Eq. 14."""
    ratio = (log_scales.amax(-1) - log_scales.amin(-1)).exp()
    return (ratio.clamp_min(max_ratio) - max_ratio).mean()
