"""Views of a Gaussian map."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from edslam_ti.camera import Camera
from edslam_ti.geometry import inverse
from edslam_ti.kernels import culling
from edslam_ti.kernels.rasterization import rasterize
from edslam_ti.mapping.gaussians import GaussianMap, Gaussians

MIN_DRAWN = 1e-3  # alpha; below this a pixel has no depth


@dataclass(frozen=True)
class RenderOutput:
    """A rendered view, differentiable in the map and the pose."""

    intensity: Tensor  # [H, W] brightness, background included
    depth: Tensor  # [H, W] metres, weighted by alpha (Eq. 8)
    alpha: Tensor  # [H, W]
    visible: Tensor  # [N] bool, Sec. III-E
    dominant: Tensor  # [H, W] int32, the Gaussian seen at each pixel, -1 where there is none

    @property
    def expected_depth(self) -> Tensor:
        """Expected depth: Eq. 8's sum divided by alpha, 0 where nothing is drawn."""
        depth = self.depth / self.alpha.clamp_min(MIN_DRAWN)
        return torch.where(self.alpha > MIN_DRAWN, depth, torch.zeros_like(depth))


@dataclass(frozen=True)
class View:
    """A rendered view as plain arrays, the same for all mappers."""

    intensity: np.ndarray  # [H, W] float32 brightness
    depth: np.ndarray  # [H, W] float32 metres, 0 = nothing drawn
    alpha: np.ndarray  # [H, W] float32


def render(
    gaussians: Gaussians,
    camera: Camera,
    T_world_camera: Tensor,  # [4, 4]
    background: float,  # brightness behind everything
) -> RenderOutput:
    """Return the map seen from a pose (Eq. 6-8)."""
    drawn = rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.colors,
        inverse(T_world_camera).float(),
        camera.intrinsics,
        (camera.width, camera.height),
    )
    intensity = drawn.image[..., 0] + (1 - drawn.alpha) * background
    return RenderOutput(intensity, drawn.depth, drawn.alpha, drawn.visible, drawn.dominant)


@torch.no_grad()
def drawable(
    gaussians: GaussianMap,  # of N
    camera: Camera,
    T_world_camera: Tensor,  # [4, 4]
) -> Tensor:  # [M] indices
    """Return the Gaussians that may show; the others lie behind the camera or end outside the image."""
    raw, T_camera_world = gaussians.raw, inverse(T_world_camera.detach())
    size = camera.width, camera.height
    return culling.drawable(raw["means"], raw["log_scales"], T_camera_world, camera.intrinsics, size)


@torch.no_grad()
def render_map(
    gaussians: GaussianMap,  # of N
    camera: Camera,
    T_world_camera: np.ndarray,  # [4, 4]
    background: float,
) -> RenderOutput:
    """Return the map seen from a pose, without gradients; only Gaussians in view cost time."""
    T = torch.from_numpy(T_world_camera)
    chosen = drawable(gaussians, camera, T)
    view = render(gaussians.activated(chosen), camera, T, background)
    visible = torch.zeros(len(gaussians), dtype=torch.bool)
    visible[chosen] = view.visible
    # Translate indices of the subset into those of the map; -1 selects the last entry, which is -1.
    of_map = torch.cat([chosen, torch.tensor([-1])]).int()
    return replace(view, visible=visible, dominant=of_map[view.dominant.long()])


@torch.no_grad()
def render_view(
    gaussians: GaussianMap, camera: Camera, T_world_camera: np.ndarray, background: float
) -> View:
    """Return a view as arrays, with median depth."""
    shown, T = gaussians.activated(), torch.from_numpy(T_world_camera)
    output = render(shown, camera, T, background)
    return View(output.intensity.numpy(), median_depth(shown, output, T).numpy(), output.alpha.numpy())


def median_depth(
    gaussians: Gaussians,
    output: RenderOutput,
    T_world_camera: Tensor,  # [4, 4]
) -> Tensor:  # [H, W] metres, 0 = nothing drawn
    """Return the depth of the Gaussian at which transmittance falls below half (Huang et al. 2024, 2DGS).

    At a depth edge expected depth lies between the two surfaces. Where transmittance stays above half, there
    is no median, and expected depth is returned.
    """
    _, _, row, _ = inverse(T_world_camera).float()
    depth = gaussians.means @ row[:3] + row[3]
    in_front = depth[output.dominant.clamp_min(0).long()] if len(depth) else output.depth
    return torch.where(output.dominant >= 0, in_front, output.expected_depth)
