"""Brightness of all Gaussians at once, by linear least squares over all accumulated events.

With l the log-brightness of the Gaussian seen at pixel x in frame k, s(x) the pixel's unknown
log-brightness at the beginning, and E_k(x) the brightness change measured since then (Eq. 11):

    l[g_k(x)] - s(x) = E_k(x) + noise        for every frame k and pixel x

Every surface that passes under a pixel is compared with every other one that does, so that brightness
spreads over the whole scene in a few iterations, where descent on single intervals (Eq. 12) needs
thousands of steps. The noise is bounded by the contrast threshold however long the interval.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

HUBER = 0.15  # log brightness; beyond, an equation counts less (pixels on an edge between two surfaces)


def solve_log_brightness(
    seen: np.ndarray,  # [F, P] int: Gaussian seen at each pixel of each frame, -1 = none
    change: np.ndarray,  # [F, P] float32: E_k, log-brightness change since the beginning
    prior: np.ndarray,  # [N] float: log-brightness before; stays where nothing was observed
    prior_weight: float = 0.001,  # weight of the prior against one equation
    iterations: int = 200,
    reweightings: int = 2,
) -> np.ndarray:  # [N] float64
    """Return the log-brightness of N Gaussians, by reweighted conjugate gradients."""
    frames, pixels = np.nonzero(seen >= 0)
    system = _Equations(seen[frames, pixels], pixels, change[frames, pixels], len(prior), seen.shape[1])
    level, weight = prior.astype(np.float64), np.ones(len(pixels))
    for _ in range(reweightings + 1):
        level = system.solved(level, weight, prior, prior_weight, iterations)
        residual = np.abs(system.residual(level, weight))
        weight = np.minimum(1.0, HUBER / np.maximum(residual, 1e-9))
    return level


@dataclass(frozen=True)
class _Equations:
    """l[gaussian] - s[pixel] = change, with s eliminated: given l, it is each pixel's weighted mean."""

    gaussian: np.ndarray  # [M]
    pixel: np.ndarray  # [M]
    change: np.ndarray  # [M]
    num_gaussians: int
    num_pixels: int

    def centred(self, values: np.ndarray, weight: np.ndarray) -> np.ndarray:  # [M], [M] -> [M]
        """Return the values less their weighted mean at the same pixel."""
        total = np.bincount(self.pixel, weight, self.num_pixels) + 1e-9
        mean = np.bincount(self.pixel, weight * values, self.num_pixels) / total
        return values - mean[self.pixel]

    def residual(self, level: np.ndarray, weight: np.ndarray) -> np.ndarray:  # [N], [M] -> [M]
        return self.centred(level[self.gaussian] - self.change, weight)

    def gathered(self, values: np.ndarray, weight: np.ndarray) -> np.ndarray:  # [M], [M] -> [N]
        """Return the weighted sum of the centred values over each Gaussian's equations."""
        return np.bincount(self.gaussian, weight * self.centred(values, weight), self.num_gaussians)

    def solved(
        self, level: np.ndarray, weight: np.ndarray, prior: np.ndarray, prior_weight: float, iterations: int
    ) -> np.ndarray:  # [N]
        """Return the least-squares levels, from a start, by Jacobi-preconditioned conjugate gradients."""
        n = self.num_gaussians
        normal = LinearOperator(
            (n, n), matvec=lambda x: self.gathered(x[self.gaussian], weight) + prior_weight * x
        )
        diagonal = np.bincount(self.gaussian, weight, n) + prior_weight
        right_side = self.gathered(self.change, weight) + prior_weight * prior
        jacobi = LinearOperator((n, n), matvec=lambda x: x / diagonal)
        solution, _ = cg(normal, right_side, x0=level, rtol=1e-4, maxiter=iterations, M=jacobi)
        return solution
