"""Recolours Gaussians after event images have been solved again."""

from collections.abc import Iterable

import numpy as np
import torch

from edslam_ti.mapping.gaussians import GaussianMap


def recolour(
    gaussians: GaussianMap,  # of N
    views: Iterable[tuple[np.ndarray, np.ndarray]],  # [H, W] Gaussian seen, -1: none; log brightness added
    is_complete: bool,  # the views are all there are
    epsilon: float,  # added to brightness before the logarithm
) -> None:
    """Add to every Gaussian's log brightness the mean change of the images at the pixels that show it.

    If the views are complete, Gaussians that no view shows get the mean change of all others.
    """
    n = len(gaussians)
    total, count = np.zeros(n), np.zeros(n)
    for dominant, added in views:
        seen, change = dominant.ravel(), added.ravel()
        drawn = seen >= 0
        total += np.bincount(seen[drawn], change[drawn], n)
        count += np.bincount(seen[drawn], minlength=n)
    if not count.any():
        return
    everywhere = total.sum() / count.sum() if is_complete else 0.0
    change = np.where(count > 0, total / np.maximum(count, 1), everywhere)
    with torch.no_grad():
        brightness = gaussians.activated().colors.numpy()[:, 0]
    new = np.exp(np.log(brightness + epsilon) + change) - epsilon
    gaussians.set_colors(torch.from_numpy(new.astype(np.float32))[:, None])
