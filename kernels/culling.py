"""Selects the Gaussians of a map that may show in a view."""

import math

import torch
from torch import Tensor

from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.projection import LOW_PASS, MARGIN, MIN_ALPHA, NEAR
from edslam_ti.kernels.runtime import check_shape, plain

REACH = math.sqrt(-2 * math.log(MIN_ALPHA))  # standard deviations to where an opaque Gaussian ends


@ti.func
def _reaches(
    offset,  # pixels from the principal point, across or down
    principal_point,
    size,
    f,
    sigma_over_z,
):
    """Whether a ball at this offset, as large as the Gaussian's largest axis, can reach the image (Eq. 7)."""
    variance = (f * f + offset * offset) * sigma_over_z * sigma_over_z + LOW_PASS
    reach = 1.0 + REACH * ti.sqrt(variance)
    return (offset + principal_point > -reach) & (offset + principal_point < size - 1 + reach)


@ti.func
def _is_near(position, size):
    """Whether a mean at this pixel is near enough to the image for rendering not to cull it."""
    margin = 1.0 + MARGIN * size
    return (position > -margin) & (position < size - 1 + margin)


@ti.kernel
def _mark_drawable(
    # inputs
    means: ti.types.ndarray(ndim=2),  # [N, 3] metres, world
    log_scales: ti.types.ndarray(ndim=2),  # [N, 3]
    pose: ti.types.ndarray(ndim=2),  # [4, 4] T_camera_world
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: ti.i32,
    height: ti.i32,
    # outputs
    is_drawable: ti.types.ndarray(ti.u8, ndim=1),  # [N]
):
    for i in range(means.shape[0]):
        p = [
            pose[a, 0] * means[i, 0] + pose[a, 1] * means[i, 1] + pose[a, 2] * means[i, 2] + pose[a, 3]
            for a in range(3)
        ]
        marked = False
        if p[2] > NEAR:
            u, v = fx * p[0] / p[2], fy * p[1] / p[2]
            if _is_near(u + cx, width) & _is_near(v + cy, height):
                largest = ti.max(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2])
                size = ti.exp(largest) / p[2]
                marked = _reaches(u, cx, width, fx, size) & _reaches(v, cy, height, fy, size)
        is_drawable[i] = ti.cast(marked, ti.u8)


def drawable(
    means: Tensor,  # [N, 3] metres, world
    log_scales: Tensor,  # [N, 3] of standard deviations in metres
    T_camera_world: Tensor,  # [4, 4]
    intrinsics: tuple[float, float, float, float],  # fx, fy, cx, cy, pixels
    size: tuple[int, int],  # (width, height)
) -> Tensor:  # [M] indices
    """Return the Gaussians that may show; the others lie behind the camera or end outside the image."""
    check_shape("means", means, (None, 3))
    check_shape("log_scales", log_scales, (len(means), 3))
    is_drawable = torch.empty(len(means), dtype=torch.uint8, device=means.device)
    if len(means):
        pose = plain("T_camera_world", T_camera_world)
        _mark_drawable(
            plain("means", means), plain("log_scales", log_scales), pose, *intrinsics, *size, is_drawable
        )
    return torch.nonzero(is_drawable).squeeze(1)
