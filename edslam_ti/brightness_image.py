"""Log-brightness images from events: what a keyframe looked like, without any camera image.

With l the unknown log brightness at the keyframe's time and E_k the change summed up since then
(Eq. 11), the image at time k is l + E_k. A surface point seen at pixel u of the keyframe and at x_k(u)
of frame k keeps its brightness:

    l(u) = l(x_k(u)) + E_k(x_k(u))           for every frame k and pixel u with depth

Linear equations in l alone; x_k comes from depth and poses, l(x) is interpolated. Unlike a time surface
(Eq. 1), which lags its edges by an amount that depends on the motion, such an image belongs to the
surfaces themselves, so that alignment to it is not biased.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

from edslam_ti.camera import Camera
from edslam_ti.events import Events
from kernels.time_surface import add_polarity

HYSTERESIS = 0.5  # thresholds
HUBER = 0.1  # log brightness; equations beyond count less (occlusions, reflections, wrong depth)
OCCLUSION = 0.03  # a point this share of its depth behind what is measured is hidden


class BrightnessChange:
    """Log-brightness change of every pixel since the beginning, from events (Eq. 11).

    A pixel's brightness lies up to one threshold C beyond its last event, in that event's direction
    unless it has turned since: C / 2 on average. Without that half threshold a moving edge of contrast g
    per pixel trails by C / 2g pixels, which biases alignment.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._sum = np.zeros(shape, np.int32)
        self._last = np.zeros(shape, np.int8)  # polarity of the last event

    def add(self, events: Events) -> None:
        """Add events that follow those added before."""
        add_polarity(events.x, events.y, events.polarity, self._sum, self._last)

    def log_brightness(self, contrast_threshold: float) -> np.ndarray:  # [H, W] float32
        """Return the change since the beginning."""
        steps = self._sum.astype(np.float32)
        steps += np.float32(HYSTERESIS) * self._last
        return np.float32(contrast_threshold) * steps

    def reset(self) -> None:
        """Begin anew."""
        self._sum[:], self._last[:] = 0, 0


@dataclass(frozen=True)
class Observation:
    """One time at which a keyframe's surfaces were seen."""

    T_camera_keyframe: np.ndarray  # [4, 4]
    change: np.ndarray  # [h, w] log brightness: E_k, since the keyframe (before it: negative time)
    depth: np.ndarray | None  # [h, w] metres, 0 = missing; for occlusion


def solve_log_brightness_image(
    depth: np.ndarray,  # [h, w] of the keyframe, metres, 0 = missing
    camera: Camera,  # of these images
    observations: Sequence[Observation],
    prior: np.ndarray,  # [h, w] log brightness before; stays where nothing was observed
    prior_weight: float = 1e-3,  # against one equation
    iterations: int = 12,
    reweightings: int = 1,
) -> np.ndarray:  # [h, w] float32
    """Return the keyframe's log brightness by conjugate gradients, robustly reweighted."""
    systems = [_equations(depth, camera, o) for o in observations]
    A = sparse.vstack([a for a, _ in systems]).tocsr()
    A_t = A.T.tocsr()
    b = np.concatenate([c for _, c in systems])
    start = prior.ravel().astype(np.float32)
    level, weight = start, np.ones(len(b), np.float32)
    squares = A_t.multiply(A_t).tocsr()
    for k in range(reweightings + 1):
        if k:
            weight = np.minimum(1, HUBER / np.maximum(np.abs(A @ level - b), 1e-6)).astype(np.float32)
        inverse_diagonal = 1 / (squares @ weight + prior_weight)
        normal = _operator(A, A_t, weight, prior_weight)
        right_side = A_t @ (weight * b) + prior_weight * start
        jacobi = LinearOperator(normal.shape, matvec=lambda x, d=inverse_diagonal: d * x, dtype=np.float32)
        level, _ = cg(normal, right_side, x0=level, rtol=1e-4, maxiter=iterations, M=jacobi)
    return level.reshape(prior.shape).astype(np.float32)


def _operator(
    A: sparse.csr_matrix, A_t: sparse.csr_matrix, weight: np.ndarray, prior_weight: float
) -> LinearOperator:
    n = A.shape[1]
    return LinearOperator(
        (n, n), matvec=lambda x: A_t @ (weight * (A @ x)) + prior_weight * x, dtype=np.float32
    )


def _equations(
    depth: np.ndarray, camera: Camera, observation: Observation
) -> tuple[sparse.csr_matrix, np.ndarray]:  # [m, h w], [m]
    """Return the rows l(u) - l(x(u)) = E(x(u)) of every pixel u seen at that time."""
    height, width = depth.shape
    v, u = np.nonzero(depth > 0)
    z = depth[v, u]
    rays = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
    T = observation.T_camera_keyframe.astype(np.float32)
    p = T[:3, :3] @ rays.astype(np.float32) + T[:3, 3:]
    x = camera.fx * p[0] / np.maximum(p[2], 1e-3) + camera.cx
    y = camera.fy * p[1] / np.maximum(p[2], 1e-3) + camera.cy
    seen = (p[2] > 0.05) & (x >= 0) & (x < width - 1.001) & (y >= 0) & (y < height - 1.001)
    own = (v * width + u)[seen]
    x, y, z = x[seen], y[seen], p[2][seen]
    column, row = x.astype(np.int32), y.astype(np.int32)
    fx, fy = x - column, y - row
    corner = row * width + column
    corners = np.stack([corner, corner + 1, corner + width, corner + width + 1], 1)  # [m, 4]
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], 1).astype(np.float32)
    if observation.depth is not None:
        measured = observation.depth.ravel()[corners]
        nearest = np.where(measured > 0, measured, np.inf).min(1)
        visible = z <= nearest * (1 + OCCLUSION) + 0.02
        own, corners, weights = own[visible], corners[visible], weights[visible]
    m = len(own)
    change = (weights * observation.change.ravel()[corners]).sum(1)
    values = np.concatenate([np.ones((m, 1), np.float32), -weights], 1).ravel()
    columns = np.concatenate([own[:, None], corners], 1).ravel()
    rows = sparse.csr_matrix((values, columns, 5 * np.arange(m + 1)), (m, height * width))
    return rows, change.astype(np.float32)
