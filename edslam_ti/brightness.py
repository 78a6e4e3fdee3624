"""The image at the beginning, solved from events, depth and poses: afterwards events are images.

Events tell how the log brightness of a pixel has changed since the beginning, E_k(x) in Eq. 11, but not
what it was then. With the start image s known, every frame is an image without blur: s + E_k. A point seen
at pixel x of frame k and at x' = w(x) of frame j (Eq. 3, through measured depth) has one brightness:

    s(x) + E_k(x) = s(x') + E_j(x')        for every pixel with depth and many pairs of frames

with s and E_j at x' interpolated bilinearly. The unknowns are the pixels of one image however long the
recording, so least squares finds all of them in seconds, whatever their distance in the image, where descent
on single intervals (Eq. 12) needs thousands of steps for the low frequencies. Frames of another, earlier
stretch, whose start is known already, tie their s + E_k in as a given. Absolute brightness stays unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

from edslam_ti.camera import Camera

HUBER = 0.15  # log brightness; beyond, an equation counts less (edges, reflections, wrong depth)
SAME_SURFACE = 0.03  # relative difference of depths up to which a warped pixel counts as seen
PRIOR_WEIGHT = 1e-3  # of the start's previous value against one equation
OFFSETS = (1, 2, 5, 9)  # in the list of views, between the two of a pair
NEAREST = 0.05  # metres in front of the camera


@dataclass(frozen=True)
class EventView:
    """What the event camera has measured up to the time of a frame."""

    change: np.ndarray  # [H, W] float32 log brightness less the start image, Eq. 11; absolute if not relative
    depth: np.ndarray | None  # [H, W] float32 metres, 0 = missing
    T_world_camera: np.ndarray  # [4, 4]
    is_relative: bool = True


@dataclass(frozen=True)
class StartImage:
    """Log brightness at the beginning."""

    log_brightness: np.ndarray  # [H, W] float32
    is_observed: np.ndarray  # [H, W] bool: compared with other pixels; elsewhere as the neighbours


def solve_start_image(
    views: Sequence[EventView],  # in order of time
    camera: Camera,
    start: np.ndarray,  # [H, W] float32, where to begin; stays where nothing is observed
    iterations: dict[int, int],  # of conjugate gradients by reduction of the images, coarse first
    reweightings: int = 2,
) -> StartImage:
    """Return the start image, by iteratively reweighted least squares from coarse to fine.

    Only its difference to `start` is at reduced size: details of `start` smaller than that survive.
    """
    log_brightness, observed = start.astype(np.float32), np.zeros(camera.shape, bool)
    for reduction, count in iterations.items():
        equations = _equations(views, camera, reduction)
        if equations is None:
            continue
        before = block_means(log_brightness, reduction)
        solution, seen = equations.solved(before.ravel(), count, reweightings)
        difference = _filled((solution - before.ravel()).reshape(before.shape), seen.reshape(before.shape))
        log_brightness = log_brightness + _enlarged(difference, camera.shape)
        observed |= _enlarged(seen.reshape(before.shape).astype(np.float32), camera.shape) > 0.5
    return StartImage(log_brightness, observed)


@dataclass(frozen=True)
class _Equations:
    """A s = b, one row a pixel of a pair of views."""

    A: sparse.csr_matrix  # [M, P] float32
    b: np.ndarray  # [M] float32

    def solved(self, start: np.ndarray, iterations: int, reweightings: int) -> tuple[np.ndarray, np.ndarray]:
        """Return s [P] and which of its pixels stand in any equation [P]."""
        squares = self.A.multiply(self.A).T.tocsr()
        solution, weight = start, np.ones(len(self.b), np.float32)
        for _ in range(reweightings):
            solution = self._fitted(solution, start, weight, squares @ weight, iterations)
            residual = np.abs(self.A @ solution - self.b)
            weight = np.minimum(1, HUBER / np.maximum(residual, 1e-9)).astype(np.float32)
        return solution, squares @ np.ones_like(weight) > 0

    def _fitted(
        self,
        solution: np.ndarray,  # [P] where to begin
        prior: np.ndarray,  # [P]
        weight: np.ndarray,  # [M]
        diagonal: np.ndarray,  # [P] of A^T W A
        iterations: int,
    ) -> np.ndarray:  # [P] float32
        """Return the weighted least-squares solution by Jacobi-preconditioned conjugate gradients."""
        n, preconditioner = len(prior), 1 / (diagonal + np.float32(PRIOR_WEIGHT))
        transposed = self.A.T

        def normal(s: np.ndarray) -> np.ndarray:
            return transposed @ (weight * (self.A @ s)) + np.float32(PRIOR_WEIGHT) * s

        right = transposed @ (weight * self.b) + np.float32(PRIOR_WEIGHT) * prior
        result, _ = cg(
            LinearOperator((n, n), normal, dtype=np.float32),
            right,
            x0=solution,
            rtol=1e-6,
            maxiter=iterations,
            M=LinearOperator((n, n), lambda s: s * preconditioner, dtype=np.float32),
        )
        return result.astype(np.float32)


def _equations(views: Sequence[EventView], camera: Camera, reduction: int) -> _Equations | None:
    """Return the equations of all pairs of views, None without any."""
    small = camera if reduction == 1 else camera.downscaled(reduction)
    changes = [block_means(v.change, reduction) for v in views]
    depths = [None if v.depth is None else _reduced_depth(v.depth, reduction) for v in views]
    rays = small.rays()
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # of pairs: columns, values, right side
    for k, j in _pairs(views):
        depth = depths[k]
        if depth is None:
            continue
        T_j_k = np.linalg.inv(views[j].T_world_camera) @ views[k].T_world_camera
        source, target, share = _warped(depth, depths[j], rays, T_j_k, small)
        right = (changes[j].ravel()[target] * share).sum(1) - changes[k].ravel()[source]
        one = np.full((len(source), 1), float(views[k].is_relative))
        columns = np.concatenate([source[:, None], target], 1)
        rows.append((columns, np.concatenate([one, -share * views[j].is_relative], 1), right))
    if not rows or not sum(len(r[2]) for r in rows):
        return None
    columns, values, right = (np.concatenate(part) for part in zip(*rows))
    first = np.arange(len(right) + 1) * columns.shape[1]
    matrix = sparse.csr_matrix(
        (values.astype(np.float32).ravel(), columns.ravel(), first), (len(right), small.width * small.height)
    )
    return _Equations(matrix, right.astype(np.float32))


def _pairs(views: Sequence[EventView]) -> list[tuple[int, int]]:
    """Return pairs of views at short and long distances in the list, both ways."""
    offsets = OFFSETS if len(views) < 12 else OFFSETS[1:]
    pairs = [(k, k + o) for o in offsets for k in range(len(views) - o)]
    pairs += [(j, k) for k, j in pairs]
    return [(k, j) for k, j in pairs if views[k].is_relative or views[j].is_relative]


def _warped(
    depth: np.ndarray,  # [h, w] of the source
    target_depth: np.ndarray | None,  # [h, w]; None: whatever is there counts as seen
    rays: np.ndarray,  # [h, w, 3]
    T_target_source: np.ndarray,  # [4, 4]
    camera: Camera,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return source pixels [M], the four target pixels around where each is seen [M, 4], their shares."""
    w = camera.width
    points = (rays * depth[..., None]) @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    z = points[..., 2]
    safe = np.maximum(z, NEAREST)
    u = camera.fx * points[..., 0] / safe + camera.cx
    v = camera.fy * points[..., 1] / safe + camera.cy
    inside = (depth > 0) & (z > NEAREST) & (u >= 0) & (v >= 0) & (u < w - 1.001) & (v < camera.height - 1.001)
    source = np.nonzero(inside.ravel())[0]
    u, v, z = u.ravel()[source], v.ravel()[source], z.ravel()[source]
    x, y = u.astype(np.int64), v.astype(np.int64)
    a, b = u - x, v - y
    corner = y * w + x
    target = np.stack([corner, corner + 1, corner + w, corner + w + 1], 1)
    share = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], 1)
    if target_depth is not None:
        seen = target_depth.ravel()[target]
        is_same = (np.abs(seen - z[:, None]) < SAME_SURFACE * z[:, None]).all(1)
        source, target, share = source[is_same], target[is_same], share[is_same]
    return source, target, share


def _filled(values: np.ndarray, known: np.ndarray) -> np.ndarray:  # [h, w]
    """Return the values where known, else the mean of what is known nearby (or 0)."""
    result, weight = np.where(known, values, 0).astype(np.float32), known.astype(np.float32)
    filled, total = result.copy(), weight.copy()
    for size in (5, 15, 45):
        blurred = cv2.blur(result, (size, size)), cv2.blur(weight, (size, size))
        gap = (total == 0) & (blurred[1] > 1e-3)
        filled[gap], total[gap] = blurred[0][gap] / blurred[1][gap], 1
    return filled


def _reduced_depth(depth: np.ndarray, reduction: int) -> np.ndarray:
    """Return block means where all depths of a block exist and lie on one surface, else missing."""
    if reduction == 1:
        return depth
    h, w = depth.shape[0] // reduction, depth.shape[1] // reduction
    blocks = depth[: h * reduction, : w * reduction].reshape(h, reduction, w, reduction)
    low, high = blocks.min((1, 3)), blocks.max((1, 3))
    return np.where((low > 0) & (high - low < 2 * SAME_SURFACE * high), blocks.mean((1, 3)), 0)


def _enlarged(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:  # [h, w] -> [H, W]
    """Return an image of block means at full size, bilinearly; odd edges repeat the last block."""
    if image.shape == shape:
        return image
    r = shape[1] // image.shape[1]
    h, w = image.shape[0] * r, image.shape[1] * r
    enlarged = cv2.resize(image.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
    return np.pad(enlarged, ((0, shape[0] - h), (0, shape[1] - w)), mode="edge")


def block_means(image: np.ndarray, reduction: int) -> np.ndarray:  # [H, W] -> [H / r, W / r]
    """Return the means of blocks of reduction x reduction pixels, odd edges cut off."""
    if reduction == 1:
        return image
    h, w = image.shape[0] // reduction, image.shape[1] // reduction
    cut = image[: h * reduction, : w * reduction]
    return cut.reshape(h, reduction, w, reduction).mean((1, 3), dtype=np.float32)
