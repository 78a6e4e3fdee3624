"""Solves for the image that explains the measured changes of brightness: matrix-free robust least squares.

Let E_k be the change of log brightness measured from the image l until time k. The image at k is l + E_k. A
point seen at pixel u at time j and at x(u) at time k has the same brightness in both images, which gives the
equation l(u) - l(x(u)) = E_k(x(u)) - E_j(u). If the image at j or k is known, its l drops out. All equations
together are A l = b, and the image minimises

    sum of rho((A l - b)_i) + lambda |l - prior|^2,    rho: Huber's function

by conjugate gradients on the normal equations A^T W A + lambda, preconditioned by their diagonal. The
residuals of the initial value give the weights W; solving again from a solution reweights. A row of A is 1 at
u and minus four bilinear weights at the corners around x(u). The four corners are read and written as one
vector, in an image of four-vectors. One worker processes the rows in order, so that sums are the same for any
number of workers.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from edslam_ti.kernels.constants import NEAR
from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.lanes import LANES, lanes, vector_instructions, zeros
from edslam_ti.kernels.runtime import CHUNK, check_shape, float_dtype, workers

# A point is occluded if it lies behind the nearest measured depth around it by more than this share of that
# depth and this margin (metres). One-sided and lenient: nearer points and missing depth count as seen.
OCCLUDED, OCCLUDED_MARGIN = 0.03, 0.02
# A point lies on the measured surface if all depths around it differ from its own by less than this share.
# Two-sided and strict, for `is_strict`: neither nearer points nor missing depth are accepted.
SAME_SURFACE = 0.03
BORDER = 1.001  # pixels; keeps all four corners inside the image
CONVERGED = 1e-14  # share of the initial squared (preconditioned) residual
NO_DEPTH = -1.0  # depth of all pixels of an image without depth, in which any surface counts as seen
KEPT_PAIRS = 32  # memory for up to this many pairs is kept: allocating costs as much time as computing

_Corners = ti.types.vector(
    4
)  # at (x - 1, y - 1), (x, y - 1), (x - 1, y), (x, y): named by (x, y), right below


def corners(ndim: int) -> ti.types.ndarray:
    """Return the type of an array argument [..., 4] of floats with `ndim` leading dimensions."""
    return ti.types.ndarray(_Corners, ndim=ndim)


@ti.kernel
def _find_rows(
    # inputs
    pairs: ti.types.ndarray(ti.i32, ndim=2),  # [K, 2] images where u and x(u) are
    projections: ti.types.ndarray(ndim=2),  # [K, 12] rows of [C R C^-1 | C t], C the camera matrix
    changes: ti.types.ndarray(ndim=1),  # [V H W]
    depths: ti.types.ndarray(ndim=1),  # [V H W] metres, 0 = missing
    is_known: ti.types.ndarray(ti.u8, ndim=1),  # [V] the change is the whole log brightness
    height: ti.i32,
    width: ti.i32,
    is_strict: ti.i32,
    num_workers: ti.i32,
    # outputs; rows of pair k start at k H W
    count: ti.types.ndarray(ti.i32, ndim=1),  # [K] rows of a pair
    place: ti.types.ndarray(ti.i64, ndim=1),  # [K H W] pixel u + 2^32 times the one right below x(u)
    bilinear: ti.types.ndarray(ndim=2),  # [K H W, 4]
    change: ti.types.ndarray(ndim=1),  # [K H W] b
):
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            worker, K = chunk // CHUNK, count.shape[0]
            right_end, lower_end = float(width) - BORDER, float(height) - BORDER
            for k in range(K * worker // num_workers, K * (worker + 1) // num_workers):
                P = [projections[k, i] for i in range(12)]
                n = height * width
                row, source, target = k * n, pairs[k, 0] * n, pairs[k, 1] * n
                known, share = is_known[pairs[k, 0]] > 0, ti.select(is_known[pairs[k, 1]] > 0, 0.0, 1.0)
                for v in range(height):
                    left_x, left_y, left_z = P[1] * v + P[2], P[5] * v + P[6], P[9] * v + P[10]
                    for u in range(width):
                        own = v * width + u
                        Z = depths[source + own]
                        z = (P[8] * u + left_z) * Z + P[11]
                        inv_z = 1.0 / ti.max(z, NEAR)
                        x = ((P[0] * u + left_x) * Z + P[3]) * inv_z
                        y = ((P[4] * u + left_y) * Z + P[7]) * inv_z
                        in_view = (x >= 0) & (x < right_end) & (y >= 0) & (y < lower_end)
                        if (Z > 0) & (z > NEAR) & in_view:
                            j, i = ti.cast(x, ti.i32), ti.cast(y, ti.i32)
                            right, down = x - j, y - i
                            left, up = 1.0 - right, 1.0 - down
                            weights = [left * up, right * up, left * down, right * down]
                            corner = target + i * width + j
                            corners_ = [corner, corner + 1, corner + width, corner + width + 1]
                            nearest, seen = 1e30, 0.0
                            for c in ti.static(range(4)):
                                measured = depths[corners_[c]]
                                nearest = ti.select((measured > 0) & (measured < nearest), measured, nearest)
                                seen += weights[c] * changes[corners_[c]]
                            is_seen = z <= nearest * (1 + OCCLUDED) + OCCLUDED_MARGIN
                            if is_strict > 0:
                                for c in ti.static(range(4)):
                                    measured = depths[corners_[c]]
                                    is_seen &= (measured < 0) | (ti.abs(measured - z) < SAME_SURFACE * z)
                            if is_seen:
                                below = i * width + j + width + 1
                                place[row] = ti.cast(below, ti.i64) << 32 | ti.select(known, n, own)
                                change[row] = seen - changes[source + own]
                                for c in ti.static(range(4)):
                                    bilinear[row, c] = share * weights[c]
                                row += 1
                count[k] = row - k * n


@ti.func
def clear(image: ti.template()):  # four-vectors
    for p in range(image.shape[0]):
        image[p] = ti.Vector([0.0, 0.0, 0.0, 0.0])


@ti.func
def folded(image: ti.template(), p, width):
    """The sum of what the four vectors around pixel p hold for it."""
    last = p + width + 1
    return image[last][0] + image[last - 1][1] + image[last - width][2] + image[last - width - 1][3]


@ti.func
def unfold(values: ti.template(), width, image: ti.template()):
    """Four-vectors of the values around each pixel's upper left corner, at that pixel."""
    for p in range(width + 1, image.shape[0] - width - 1):
        image[p] = ti.Vector([values[p - width - 1], values[p - width], values[p - 1], values[p]])


@ti.func
def dot(a: ti.template(), b: ti.template(), num_lanes):
    total = zeros()
    for i in range(num_lanes):
        total += a[i] * b[i]
    return total.sum()


@vector_instructions
@ti.kernel
def _solve(
    # inputs
    width: ti.i32,
    count: ti.types.ndarray(ti.i32, ndim=1),  # [K]
    place: ti.types.ndarray(ti.i64, ndim=1),  # [K H W]
    bilinear: corners(1),  # [K H W]
    change: ti.types.ndarray(ndim=1),  # [K H W]
    prior: lanes(1),  # [N / LANES]
    prior_weight: float,
    huber: float,
    iterations: ti.i32,
    is_robust: ti.i32,
    # in and out
    level: ti.types.ndarray(ndim=1),  # [N] N > H W; what is known stands at H W, as 0
    level_lanes: lanes(1),  # the same memory
    # scratch
    weight: ti.types.ndarray(ndim=1),  # [K H W] robust
    around: corners(1),  # [H W + width + 1]
    sums: corners(1),  # [H W + width + 1]
    squares: corners(1),  # [H W + width + 1]
    diagonal: ti.types.ndarray(ndim=1),  # [N] ones in; of the preconditioner
    diagonal_lanes: lanes(1),
    residual: ti.types.ndarray(ndim=1),  # [N] zeros in
    residual_lanes: lanes(1),
    direction: ti.types.ndarray(ndim=1),  # [N] zeros in
    direction_lanes: lanes(1),
    image: ti.types.ndarray(ndim=1),  # [N] zeros in; (A^T W A + lambda) direction
    image_lanes: lanes(1),
):
    ti.loop_config(serialize=True)
    for _ in range(1):  # Taichi may split the outermost loop among workers
        n, num_lanes = around.shape[0] - width - 1, level_lanes.shape[0]
        # r = A^T W (b - A l) + lambda (prior - l), and the diagonal
        unfold(level, width, around)
        clear(sums)
        clear(squares)
        for i in range(num_lanes):
            residual_lanes[i] = prior_weight * (prior[i] - level_lanes[i])
            diagonal_lanes[i] = zeros() + prior_weight
        for k in range(count.shape[0]):
            for row in range(k * n, k * n + count[k]):
                packed, w = place[row], bilinear[row]
                u, c = ti.cast(packed, ti.i32), ti.cast(packed >> 32, ti.i32)
                error = change[row] - level[u] + (w * around[c]).sum()
                size = ti.select(error < 0, 0.0 - error, error)
                robust = ti.select((is_robust > 0) & (size > huber), huber / size, 1.0)
                weight[row] = robust
                # One of the corners may be u itself: then the squared entry is (1 - its weight)^2.
                twice = (
                    w[0] * (c - width - 1 == u)
                    + w[1] * (c - width == u)
                    + w[2] * (c - 1 == u)
                    + w[3] * (c == u)
                )
                residual[u] = residual[u] + robust * error
                diagonal[u] = diagonal[u] + robust * (1 - 2 * twice)
                sums[c] = sums[c] + (robust * error) * w
                squares[c] = squares[c] + robust * w * w
        residual[n] = 0.0
        for u in range(n):
            residual[u] = residual[u] - folded(sums, u, width)
            diagonal[u] = 1.0 / (diagonal[u] + folded(squares, u, width))
        for i in range(num_lanes):
            direction_lanes[i] = diagonal_lanes[i] * residual_lanes[i]
        rho = dot(residual_lanes, direction_lanes, num_lanes)
        enough = CONVERGED * rho
        for _iteration in range(iterations):
            if rho > enough:
                unfold(direction, width, around)
                clear(sums)
                for i in range(num_lanes):
                    image_lanes[i] = prior_weight * direction_lanes[i]
                for k in range(count.shape[0]):
                    for row in range(k * n, k * n + count[k]):
                        u, c, w = (
                            ti.cast(place[row], ti.i32),
                            ti.cast(place[row] >> 32, ti.i32),
                            bilinear[row],
                        )
                        value = weight[row] * (direction[u] - (w * around[c]).sum())
                        image[u] = image[u] + value
                        sums[c] = sums[c] + value * w
                image[n] = 0.0
                for u in range(n):
                    image[u] = image[u] - folded(sums, u, width)
                step = rho / dot(direction_lanes, image_lanes, num_lanes)
                total = zeros()
                for i in range(num_lanes):
                    level_lanes[i] = level_lanes[i] + step * direction_lanes[i]
                    left = residual_lanes[i] - step * image_lanes[i]
                    residual_lanes[i] = left
                    total += left * left * diagonal_lanes[i]
                before = rho
                rho = total.sum()
                for i in range(num_lanes):
                    direction_lanes[i] = (
                        diagonal_lanes[i] * residual_lanes[i] + (rho / before) * direction_lanes[i]
                    )


class ChangeImage(NamedTuple):
    """The measurement at one time."""

    change: np.ndarray  # [H, W] log brightness minus the unknown image
    depth: np.ndarray | None  # [H, W] metres, 0 = missing
    is_known: bool = False  # `change` is the whole log brightness


class Pair(NamedTuple):
    """Two images: each pixel with depth in the first gives an equation if the second sees its point."""

    first: int  # index of an image
    second: int
    T_second_first: np.ndarray  # [4, 4]


class _Memory:
    """Arrays for up to K pairs of V images."""

    def __init__(self, K: int, V: int, n: int, width: int, dtype: torch.dtype) -> None:
        numpy_dtype = np.float64 if dtype == torch.float64 else np.float32
        self.changes, self.depths = np.empty((2, V, n), numpy_dtype)
        self.place = np.empty(K * n, np.int64)
        self.bilinear = torch.empty(K * n, 4, dtype=dtype)
        self.change, self.weight = np.empty((2, K * n), numpy_dtype)
        self.vectors = torch.empty(6, (n // LANES + 1) * LANES, dtype=dtype)
        self.around = torch.empty(3, n + width + 1, 4, dtype=dtype)


_kept_memory = functools.lru_cache(maxsize=2)(_Memory)


def solve_brightness_image(
    images: Sequence[ChangeImage],  # V of them
    pairs: Sequence[Pair],  # K of them
    intrinsics: tuple[float, float, float, float],  # fx, fy, cx, cy, pixels
    prior: np.ndarray,  # [H, W] log brightness; kept where nothing was observed
    prior_weight: float,  # lambda
    huber: float,  # log brightness
    iterations: int,  # of conjugate gradients
    is_robust: Sequence[bool],  # one per solve; each starts from the one before, the first from the prior
    is_strict: bool = False,
) -> tuple[np.ndarray, np.ndarray]:  # [H, W], [H, W] bool
    """Return the log brightness, and which of its pixels occur in an equation.

    A robust solve gives less weight to equations that the previous solution fits badly; other solves weight
    all alike. Occluded points are left out; with `is_strict` also points where the second image's depth is
    missing or differs. Do not call it from two threads at once: calls share their memory.
    """
    if prior_weight <= 0:
        raise ValueError(f"prior_weight: expected a positive weight, got {prior_weight}")
    for k, image in enumerate(images):
        check_shape(f"images[{k}].change", image.change, prior.shape)
        if image.depth is not None:
            check_shape(f"images[{k}].depth", image.depth, prior.shape)
    with_depth = [p for p in pairs if images[p.first].depth is not None]
    if not with_depth:
        return prior.copy(), np.zeros(prior.shape, bool)
    K, V, (height, width), n = len(with_depth), len(images), prior.shape, prior.size
    room = max(8, 1 << (K - 1).bit_length())
    make = _kept_memory if room <= KEPT_PAIRS else _Memory
    memory = make(room, max(8, 1 << (V - 1).bit_length()), n, width, float_dtype())
    for k, image in enumerate(images):
        memory.changes[k] = image.change.reshape(-1)
        memory.depths[k] = NO_DEPTH if image.depth is None else image.depth.reshape(-1)
    dtype = memory.changes.dtype
    count = np.empty(K, np.int32)
    _find_rows(
        np.array([(p.first, p.second) for p in with_depth], np.int32),
        _projections([p.T_second_first for p in with_depth], intrinsics).astype(dtype),
        memory.changes.reshape(-1), memory.depths.reshape(-1),
        np.array([i.is_known for i in images], np.uint8), height, width, int(is_strict), min(workers(), K),
        count, memory.place, memory.bilinear.numpy(), memory.change,
    )  # fmt: skip
    start, level, *others = memory.vectors
    memory.vectors.numpy()[:] = 0
    level.numpy()[:n] = start.numpy()[:n] = prior.reshape(-1)
    for robust in is_robust:
        _solve(
            width, count, memory.place, memory.bilinear, memory.change, start.view(-1, LANES),
            prior_weight, huber, iterations, int(robust), level, level.view(-1, LANES),
            memory.weight, *memory.around, *(a for o in others for a in (o, o.view(-1, LANES))),
        )  # fmt: skip
    inverse_diagonal = others[0].numpy()[:n]
    is_observed = inverse_diagonal < (1 - 1e-3) / prior_weight
    return level.numpy()[:n].reshape(height, width).copy(), is_observed.reshape(height, width)


def _projections(poses: Sequence[np.ndarray], intrinsics: tuple[float, float, float, float]) -> np.ndarray:
    """Return the rows of [C R C^-1 | C t] as [K, 12], C the camera matrix."""
    fx, fy, cx, cy = intrinsics
    C = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    projections = C @ np.array(poses, np.float64)[:, :3]
    projections[:, :, :3] = projections[:, :, :3] @ np.linalg.inv(C)
    return projections.reshape(-1, 12)


def compile_kernels() -> None:
    """Compile the kernels of a solve, so that the first frames of a sequence do not wait for it."""
    image = ChangeImage(np.ones((3, 3), np.float32), np.ones((3, 3), np.float32))
    pair = Pair(0, 0, np.eye(4))
    solve_brightness_image([image], [pair], (1.0, 1.0, 0.0, 0.0), image.change, 1.0, 1.0, 1, [False])
