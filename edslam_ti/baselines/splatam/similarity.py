"""Structural similarity of images as tensors (Wang et al. 2004), differentiable in one of them."""

from dataclasses import dataclass

import torch
from torch import Tensor

WINDOW, SIGMA = 11, 1.5  # pixels, as in 3D Gaussian splatting
C1, C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class Target:
    """An image to compare with, and its local moments."""

    image: Tensor  # [H, W] in [0, 1]
    mean: Tensor  # [H, W]
    variance: Tensor  # [H, W]


class Similarity:
    """SSIM of images of one size; zeros surround them.

    A separable blur is two products with banded matrices. On one core that takes a sixth of the time of
    torch's convolution with one channel.
    """

    def __init__(self, height: int, width: int, device: str) -> None:
        self._down, self._across = _blur(height, device), _blur(width, device)

    def target(self, image: Tensor) -> Target:  # [H, W]
        """Return an image with its moments, to be compared with several renders."""
        mean, square = self._blurred(torch.stack([image, image * image]))
        return Target(image, mean, square - mean * mean)

    def __call__(self, image: Tensor, target: Target) -> Tensor:  # [H, W] -> scalar
        """Return the mean SSIM, 1 for equal images."""
        parts = torch.stack([image, image * image, image * target.image])
        mean, square, product = self._blurred(parts)
        variance, covariance = square - mean * mean, product - mean * target.mean
        top = (2 * mean * target.mean + C1) * (2 * covariance + C2)
        bottom = (mean * mean + target.mean**2 + C1) * (variance + target.variance + C2)
        return (top / bottom).mean()

    def _blurred(self, images: Tensor) -> Tensor:  # [K, H, W]
        return self._down @ images @ self._across


def _blur(size: int, device: str) -> Tensor:  # [size, size], symmetric
    offset = torch.arange(size, dtype=torch.float32, device=device)
    distance = (offset[:, None] - offset[None]).abs()
    weights = torch.exp(-(distance**2) / (2 * SIGMA**2)) * (distance <= WINDOW // 2)
    taps = torch.exp(-((torch.arange(WINDOW) - WINDOW // 2) ** 2) / (2 * SIGMA**2))
    return weights / float(taps.sum())
