"""LPIPS (Zhang et al. 2018, version 0.1, AlexNet): from a weights file, or from the `lpips` package."""

from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from edslam_ti.errors import DataError


class ImageDistance(Protocol):
    """A distance of two images."""

    def __call__(self, a: np.ndarray, b: np.ndarray) -> float:
        """Return the distance of two images [H, W] or [H, W, 3] (RGB) in [0, 1]."""


class Lpips:
    """Perceptual distance: AlexNet features, normalised per pixel, squared differences, learned weights."""

    # torchvision's AlexNet: (index of the convolution, stride, padding, max-pooling before it)
    LAYERS = ((0, 4, 2, False), (3, 1, 2, True), (6, 1, 1, True), (8, 1, 1, False), (10, 1, 1, False))

    def __init__(self, weights: Path) -> None:
        """Read a torch state dict with `features.N.{weight,bias}` and `linK.model.1.weight`."""
        if not weights.is_file():
            raise FileNotFoundError(f"{weights}: LPIPS weights not found")
        try:
            state = torch.load(weights, map_location="cpu", weights_only=True)
            self._convolutions = [
                (state[f"features.{k}.weight"], state[f"features.{k}.bias"], stride, padding, pool)
                for k, stride, padding, pool in self.LAYERS
            ]
            self._linear = [state[f"lin{k}.model.1.weight"] for k in range(len(self.LAYERS))]
        except Exception as error:  # torch.load raises any exception of unpickling
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            raise DataError(
                f"{weights}: expected LPIPS weights (a torch state dict with features.N.weight, "
                f"features.N.bias and linK.model.1.weight); {reason}"
            ) from error
        self._shift = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
        self._scale = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)

    @torch.no_grad()
    def __call__(self, a: np.ndarray, b: np.ndarray) -> float:
        """Return the distance of two images [H, W] or [H, W, 3] (RGB) in [0, 1], at least 32x32 pixels."""
        distance = 0.0
        for linear, f, g in zip(self._linear, self._features(a), self._features(b)):
            distance += float(F.conv2d((f - g) ** 2, linear).mean())
        return distance

    def _features(self, image: np.ndarray) -> list[Tensor]:
        x = (2 * _rgb_tensor(image) - 1 - self._shift) / self._scale
        features = []
        for weight, bias, stride, padding, pool in self._convolutions:
            if pool:
                x = F.max_pool2d(x, 3, 2)
            x = F.relu(F.conv2d(x, weight, bias, stride, padding))
            features.append(_unit_length(x))
        return features


def _unit_length(x: Tensor) -> Tensor:  # [1, C, h, w], along the channels
    return x / (x.norm(dim=1, keepdim=True) + 1e-10)


def _rgb_tensor(image: np.ndarray) -> Tensor:  # [H, W] or [H, W, 3] -> [1, 3, H, W]
    x = torch.from_numpy(np.ascontiguousarray(np.clip(image, 0, 1), np.float32))
    return (x[..., None].expand(-1, -1, 3) if x.ndim == 2 else x).permute(2, 0, 1)[None]


class _PackageLpips:
    """The `lpips` package's own network."""

    def __init__(self, package: Any) -> None:
        self._network = package.LPIPS(net="alex", verbose=False)

    @torch.no_grad()
    def __call__(self, a: np.ndarray, b: np.ndarray) -> float:
        return float(self._network(2 * _rgb_tensor(a) - 1, 2 * _rgb_tensor(b) - 1))


@cache
def load_lpips(weights: Path | None) -> ImageDistance | None:
    """Return LPIPS from a weights file, else from the `lpips` package, else None."""
    if weights is not None:
        return Lpips(weights)
    try:
        import lpips
    except ImportError:
        return None
    try:
        return _PackageLpips(lpips)
    except OSError:  # the package downloads AlexNet; there is no network
        return None
