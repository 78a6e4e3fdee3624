"""What the map is optimised for: events, depth and the shape of its Gaussians (Eq. 10-12, 14-16)."""

import torch
from torch import Tensor


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


def depth_loss(
    rendered: Tensor,  # [H, W] metres, weighted by alpha: a gap in the map counts as missing depth
    measured: Tensor,  # [H, W] metres, 0 = missing
) -> Tensor:
    """Return the mean absolute depth error over measured pixels, metres, Eq. 15."""
    valid = measured > 0
    return (rendered - measured).abs()[valid].mean() if bool(valid.any()) else rendered.sum() * 0


def scale_loss(
    log_scales: Tensor,  # [G, 3]
    max_ratio: float,  # r
) -> Tensor:
    """Return how much longer than r times their thickness Gaussians are on average, Eq. 14."""
    ratio = (log_scales.amax(-1) - log_scales.amin(-1)).exp()
    return (ratio.clamp_min(max_ratio) - max_ratio).mean()
