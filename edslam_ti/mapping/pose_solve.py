"""A pose from the event loss against a fixed map, by Gauss-Newton steps.

The image at an earlier moment is rendered, and the change measured since then (Eq. 11) is added to it. What
remains between that sum and the render at the pose sought is the residual of Eq. 12. With L the rendered log
brightness at T, and p the point that a pixel shows, T <- T exp(xi) changes L by (grad L) J(p) xi. J is the
motion of the image of a point that stands still, with its sign changed.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from edslam_ti.camera import NEAREST
from edslam_ti.geometry import orthonormalized, se3_exp, skew
from edslam_ti.mapping.brightness_solve import HUBER
from edslam_ti.mapping.change_loss import Reduction
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.rendering import render_map

OPAQUE = 0.5  # a rendered pixel with at least this alpha shows a surface
FEWEST_PIXELS = 50
DAMPING = 1e-3  # of the normal equations' diagonal
SMALL_STEP = 1e-5  # metres, radians


@dataclass(frozen=True)
class SolvedPose:
    """A pose, and how much of the change since the earlier moment it explains."""

    T_world_camera: np.ndarray  # [4, 4]
    explained: float  # share, below 0 where the map says less than nothing


@torch.no_grad()
def solve_pose(
    gaussians: GaussianMap,
    start: np.ndarray,  # [4, 4] T_world_camera
    image: Tensor,  # [H, W] log brightness at the moment sought
    change: Tensor,  # [H, W] of it that was measured since the earlier moment
    levels: tuple[Reduction, ...],  # coarse to fine
    background: float,
    epsilon: float,
    iterations: int,  # at each level
) -> SolvedPose:
    """Return the pose at which the map looks most like the image."""
    T, explained = start, 0.0
    for reduction in levels:
        target, moved = reduction.reduced(image), reduction.reduced(change)
        for _ in range(iterations):
            view = render_map(gaussians, reduction.camera, T, background)
            log = (view.intensity + epsilon).log()
            is_shown = view.alpha > OPAQUE
            if int(is_shown.sum()) < FEWEST_PIXELS:
                return SolvedPose(start, 0.0)
            A = _jacobian(log, view.expected_depth, reduction)[is_shown]
            residual = (target - log)[is_shown]
            energy = float(moved[is_shown].square().mean())
            explained = 1 - float(residual.square().mean()) / max(energy, 1e-12)
            weight = (HUBER / residual.abs().clamp_min(1e-6)).clamp_max(1.0)
            weighted = A * weight[:, None]
            H, g = (weighted.T @ A).double(), (weighted.T @ residual).double()
            xi = torch.linalg.solve(H + torch.diag(DAMPING * H.diagonal() + 1e-9), g)
            T = orthonormalized(T @ se3_exp(xi.numpy()))
            if float(xi.abs().max()) < SMALL_STEP:
                break
    return SolvedPose(T, explained) if np.isfinite(T).all() else SolvedPose(start, 0.0)


def _jacobian(log: Tensor, depth: Tensor, reduction: Reduction) -> Tensor:  # [h, w] each -> [h, w, 6]
    """Return the change of every pixel's log brightness by the twist of the camera."""
    camera = reduction.camera
    down, across = torch.gradient(log)
    v, u = torch.meshgrid(
        torch.arange(camera.height, device=log.device),
        torch.arange(camera.width, device=log.device),
        indexing="ij",
    )
    z = depth.clamp_min(NEAREST)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy  # at z = 1
    a, b = across * camera.fx / z, down * camera.fy / z
    by_point = torch.stack([a, b, -(a * x + b * y)], -1)  # grad L . d pixel / d point
    point = torch.stack([x * z, y * z, z], -1)
    # The camera's motion xi moves a point by -(v + w x p), and what is shown at a pixel against that.
    return torch.cat([by_point, -(by_point[..., None, :] @ skew(point))[..., 0, :]], -1)
