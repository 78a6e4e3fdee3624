"""Adaptive density control: clone, split, prune, reset opacities (Kerbl et al. 2023, Sec. 5.2).

Thresholds are those of gsplat's DefaultStrategy; gradients have its units (half an image width).
gsplat starts from sparse points. Here depth already puts a Gaussian at every second pixel (Eq. 13), so
densification is optional.
"""

import numpy as np
import torch
from torch import Tensor

from edslam_ti.camera import Camera
from edslam_ti.geometry import inverse
from edslam_ti.mapping.gaussians import GaussianMap

SMALL = 0.01  # of the scene's size: larger Gaussians are split, smaller ones cloned (gsplat: grow_scale3d)
LARGE = 0.1  # of the scene's size: larger Gaussians are pruned (gsplat: prune_scale3d)
SHRINKING = 1.6  # scales of a split Gaussian are divided by this
FAINTEST = 0.005  # opacity; opacities are reset to twice this value (gsplat: prune_opa)


def scene_size(gaussians: GaussianMap, positions: np.ndarray) -> float:  # [F, 3] of the camera, metres
    """Return the median distance in metres of the Gaussians from the middle of the path."""
    means = gaussians.raw["means"].detach().numpy()
    return float(np.median(np.linalg.norm(means - positions.mean(0), axis=1)))


class Densifier:
    """Sums every Gaussian's gradient in the image, and clones, splits and prunes accordingly."""

    def __init__(self, camera: Camera, size: float, min_gradient: float, most: int, seed: int) -> None:
        """Start with no gradients observed.

        `size`: of the scene, metres. `min_gradient`: a Gaussian whose mean gradient exceeds this becomes two.
        `most`: the largest number of Gaussians.
        """
        self._camera = camera
        self._size = size
        self._min_gradient = min_gradient
        self._most = most
        self._generator = torch.Generator().manual_seed(seed)
        self._pull = torch.zeros(0)  # [N] sum of gradients
        self._count = torch.zeros(0)  # [N] number of views summed

    @torch.no_grad()
    def observe(
        self,
        num_gaussians: int,
        chosen: Tensor,  # [M] indices of the Gaussians in view
        means: Tensor,  # [M, 3] metres, world
        gradient: Tensor,  # [M, 3] of the loss with respect to the means
        T_world_camera: Tensor,  # [4, 4]
    ) -> None:
        """Add one view's gradients; between calls, only `refine` may change the number of Gaussians."""
        if len(self._pull) != num_gaussians:
            self._pull, self._count = torch.zeros(num_gaussians), torch.zeros(num_gaussians)
        T = inverse(T_world_camera.detach()).float()
        p, g = means @ T[:3, :3].T + T[:3, 3], gradient @ T[:3, :3].T
        ray = p / p.norm(dim=1, keepdim=True)
        across = g - (g * ray).sum(1, keepdim=True) * ray  # moves the mean in the image: z / f metres a pixel
        pixels = across.norm(dim=1) * p[:, 2] / self._camera.fx
        is_drawn = pixels > 0
        self._pull.index_add_(0, chosen, pixels * self._camera.width / 2)
        self._count.index_add_(0, chosen, is_drawn.float())

    @torch.no_grad()
    def refine(self, gaussians: GaussianMap) -> None:
        """Clone small and split large Gaussians with a strong gradient, prune faint and huge ones."""
        is_pulled = self._pull / self._count.clamp_min(1) > self._min_gradient
        largest = gaussians.raw["log_scales"].amax(1).exp()
        is_small = largest <= SMALL * self._size
        remaining = max(self._most - len(gaussians), 0)
        split = torch.nonzero(is_pulled & ~is_small).squeeze(1)[:remaining]
        cloned = torch.nonzero(is_pulled & is_small).squeeze(1)[: remaining - len(split)]
        gaussians.clone(cloned)
        self._split(gaussians, split)
        opacity, largest = (
            gaussians.raw["logit_opacities"].sigmoid(),
            gaussians.raw["log_scales"].amax(1).exp(),
        )
        gaussians.keep((opacity > FAINTEST) & (largest < LARGE * self._size))
        self._pull, self._count = torch.zeros(len(gaussians)), torch.zeros(len(gaussians))

    def _split(self, gaussians: GaussianMap, chosen: Tensor) -> None:
        """Replace each chosen Gaussian by two smaller ones whose means are drawn from it."""
        both = torch.cat([chosen, gaussians.clone(chosen)])
        raw = {name: gaussians.raw[name][both] for name in ("means", "quats", "log_scales")}
        within = raw["log_scales"].exp() * torch.randn(len(both), 3, generator=self._generator)
        gaussians.overwrite("means", both, raw["means"] + _rotated(within, raw["quats"]))
        gaussians.overwrite("log_scales", both, raw["log_scales"] - np.log(SHRINKING))

    @torch.no_grad()
    def reset_opacities(self, gaussians: GaussianMap) -> None:
        """Make all Gaussians faint; optimisation restores those that images need, but not floaters."""
        everyone = torch.arange(len(gaussians))
        faint = torch.tensor(2 * FAINTEST).logit()
        gaussians.overwrite("logit_opacities", everyone, gaussians.raw["logit_opacities"].clamp_max(faint))


def _rotated(vectors: Tensor, quats: Tensor) -> Tensor:  # [N, 3], [N, 4] wxyz of any norm -> [N, 3]
    unit = quats / quats.norm(dim=1, keepdim=True)
    w, axis = unit[:, :1], unit[:, 1:]
    turned = torch.linalg.cross(axis, vectors)
    return vectors + 2 * (w * turned + torch.linalg.cross(axis, turned))
