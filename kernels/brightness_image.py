"""The image from which the observed changes of brightness follow: robust least squares, matrix-free.

Pixel u of a keyframe, seen at x_k(u) at time k, gives the equation l(u) - l(x_k(u)) = E_k(x_k(u)) in the
log brightness l; A l = b are all of them, and the image minimises

    sum of rho((A l - b)_i) + lambda |l - prior|^2,    rho: Huber's function

by conjugate gradients on the normal equations A^T W A + lambda, preconditioned by their diagonal and
reweighted. A row of A is 1 at u and minus four bilinear weights at the corners around x_k(u): read and
written as one vector, from and to an image of four-vectors. One worker takes the rows in their order, so that
sums are the same for any number of workers; waking a second one twice an iteration costs more than it saves.
"""

import numpy as np
import taichi as ti
import torch

from kernels.lanes import LANES, lanes, vector_instructions, zeros
from kernels.runtime import CHUNK, check_shape, float_dtype, workers

NEAR = 0.05  # metres
OCCLUSION, OCCLUSION_MARGIN = 0.03, 0.02  # share of depth, metres: this far behind what is measured is hidden
BORDER = 1.001  # pixels; all four corners are in the image
CONVERGED = 1e-10  # of the squared residual, preconditioned, at the start

_Corners = ti.types.vector(4)  # values at (x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)


def corners(ndim: int) -> ti.types.ndarray:
    """Return the type of an array argument [..., 4] of floats with `ndim` leading dimensions."""
    return ti.types.ndarray(_Corners, ndim=ndim)


@ti.kernel
def _find_rows(
    # inputs
    depth: ti.types.ndarray(ndim=2),  # [H, W] metres, 0 = missing
    poses: ti.types.ndarray(ndim=2),  # [K, 12] rows of T_camera_keyframe
    changes: ti.types.ndarray(ndim=3),  # [K, H, W]
    depths: ti.types.ndarray(ndim=3),  # [K, H, W] metres, 0 = missing
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    num_workers: ti.i32,
    # outputs
    count: ti.types.ndarray(ti.i32, ndim=1),  # [K] rows of an observation
    own: ti.types.ndarray(ti.i32, ndim=1),  # [K H W] pixel u
    corner: ti.types.ndarray(ti.i32, ndim=1),  # [K H W] the pixel above and left of x_k(u)
    bilinear: ti.types.ndarray(ndim=2),  # [K H W, 4]
    change: ti.types.ndarray(ndim=1),  # [K H W] b
):
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            worker, K = chunk // CHUNK, count.shape[0]
            height, width = depth.shape[0], depth.shape[1]
            for k in range(K * worker // num_workers, K * (worker + 1) // num_workers):
                T = [poses[k, i] for i in range(12)]
                first = k * height * width
                row = first
                for v in range(height):
                    for u in range(width):
                        Z = depth[v, u]
                        X, Y = (u - cx) / fx * Z, (v - cy) / fy * Z
                        z = T[8] * X + T[9] * Y + T[10] * Z + T[11]
                        inv_z = 1.0 / ti.max(z, NEAR)
                        x = fx * (T[0] * X + T[1] * Y + T[2] * Z + T[3]) * inv_z + cx
                        y = fy * (T[4] * X + T[5] * Y + T[6] * Z + T[7]) * inv_z + cy
                        in_view = (x >= 0) & (x < width - BORDER) & (y >= 0) & (y < height - BORDER)
                        if (Z > 0) & (z > NEAR) & in_view:
                            i, j = ti.cast(y, ti.i32), ti.cast(x, ti.i32)
                            down, right = y - i, x - j
                            up, left = 1 - down, 1 - right
                            weights = [left * up, right * up, left * down, right * down]
                            nearest, seen = 1e30, 0.0
                            for c in ti.static(range(4)):
                                measured = depths[k, i + c // 2, j + c % 2]
                                nearest = ti.select((measured > 0) & (measured < nearest), measured, nearest)
                                seen += weights[c] * changes[k, i + c // 2, j + c % 2]
                            if z <= nearest * (1 + OCCLUSION) + OCCLUSION_MARGIN:
                                own[row], corner[row] = v * width + u, i * width + j
                                change[row] = seen
                                for c in ti.static(range(4)):
                                    bilinear[row, c] = weights[c]
                                row += 1
                count[k] = row - first


@ti.func
def clear(image: ti.template()):  # four-vectors
    for p in range(image.shape[0]):
        image[p] = ti.Vector([0.0, 0.0, 0.0, 0.0])


@ti.func
def folded(image: ti.template(), p, width):
    """What four-vectors hold for pixel p; `image` begins a row and a pixel before the first one."""
    last = p + width + 1
    return image[last][0] + image[last - 1][1] + image[last - width][2] + image[last - width - 1][3]


@ti.func
def unfold(values: ti.template(), width, image: ti.template()):
    """Four-vectors of the values at each pixel's corners."""
    for p in range(image.shape[0] - width - 1):
        image[p] = ti.Vector([values[p], values[p + 1], values[p + width], values[p + width + 1]])


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
    own: ti.types.ndarray(ti.i32, ndim=1),  # [K H W]
    corner: ti.types.ndarray(ti.i32, ndim=1),  # [K H W]
    bilinear: corners(1),  # [K H W]
    change: ti.types.ndarray(ndim=1),  # [K H W]
    prior: lanes(1),  # [N / LANES]
    prior_weight: float,
    huber: float,
    iterations: ti.i32,
    reweightings: ti.i32,
    # in and out
    level: ti.types.ndarray(ndim=1),  # [N] N >= H W
    level_lanes: lanes(1),  # the same memory
    # scratch
    weight: ti.types.ndarray(ndim=1),  # [K H W] robust
    around: corners(1),  # [H W]
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
    for reweighting in range(reweightings + 1):
        n, num_lanes = around.shape[0], level_lanes.shape[0]
        # r = A^T W (b - A l) + lambda (prior - l), and the diagonal
        unfold(level, width, around)
        clear(sums)
        clear(squares)
        for i in range(num_lanes):
            residual_lanes[i] = prior_weight * (prior[i] - level_lanes[i])
            diagonal_lanes[i] = zeros() + prior_weight
        for k in range(count.shape[0]):
            for row in range(k * n, k * n + count[k]):
                u, c, w = own[row], corner[row], bilinear[row]
                error = change[row] - level[u] + (w * around[c]).sum()
                size = ti.select(error < 0, 0.0 - error, error)
                robust = ti.select((reweighting > 0) & (size > huber), huber / size, 1.0)
                weight[row] = robust
                residual[u] = residual[u] + robust * error
                diagonal[u] = diagonal[u] + robust
                sums[c + width + 1] = sums[c + width + 1] + (robust * error) * w
                squares[c + width + 1] = squares[c + width + 1] + robust * w * w
        for u in range(n):
            residual[u] = residual[u] - folded(sums, u, width)
            diagonal[u] = 1.0 / (diagonal[u] + folded(squares, u, width))
        for i in range(num_lanes):
            direction_lanes[i] = diagonal_lanes[i] * residual_lanes[i]
        rho = dot(residual_lanes, direction_lanes, num_lanes)
        enough = CONVERGED * rho
        for _ in range(iterations):
            if rho > enough:
                unfold(direction, width, around)
                clear(sums)
                for i in range(num_lanes):
                    image_lanes[i] = prior_weight * direction_lanes[i]
                for k in range(count.shape[0]):
                    for row in range(k * n, k * n + count[k]):
                        u, c, w = own[row], corner[row], bilinear[row]
                        value = weight[row] * (direction[u] - (w * around[c]).sum())
                        image[u] = image[u] + value
                        sums[c + width + 1] = sums[c + width + 1] + value * w
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


def solve_brightness_image(
    depth: np.ndarray,  # [H, W] of the keyframe, metres, 0 = missing
    intrinsics: tuple[float, float, float, float],  # fx, fy, cx, cy, pixels
    poses: np.ndarray,  # [K, 4, 4] T_camera_keyframe
    changes: np.ndarray,  # [K, H, W] log brightness since the keyframe
    depths: np.ndarray,  # [K, H, W] metres, 0 = missing; hidden points are left out
    prior: np.ndarray,  # [H, W] log brightness; stays where nothing was observed
    prior_weight: float,  # lambda
    huber: float,  # log brightness
    iterations: int,  # of conjugate gradients, for each weighting
    reweightings: int,  # after a first solution in which all equations count alike
) -> np.ndarray:  # [H, W]
    """Return the keyframe's log brightness."""
    K, height, width = changes.shape
    for name, array, shape in (
        ("depth", depth, (height, width)),
        ("poses", poses, (K, 4, 4)),
        ("depths", depths, changes.shape),
        ("prior", prior, (height, width)),
    ):
        check_shape(name, array, shape)
    if prior_weight <= 0:
        raise ValueError(f"prior_weight: expected a positive weight, got {prior_weight}")
    dtype, n = float_dtype(), height * width
    numpy_dtype = np.float64 if dtype == torch.float64 else np.float32
    if K == 0:
        return prior.astype(numpy_dtype)
    depth, poses, changes, depths = (
        np.ascontiguousarray(a, numpy_dtype) for a in (depth, poses[:, :3].reshape(K, 12), changes, depths)
    )
    count = np.empty(K, np.int32)
    own, corner = np.empty((2, K * n), np.int32)
    bilinear = torch.empty(K * n, 4, dtype=dtype)
    change, weight = np.empty((2, K * n), numpy_dtype)
    _find_rows(
        depth, poses, changes, depths, *intrinsics, min(workers(), K),
        count, own, corner, bilinear.numpy(), change,
    )  # fmt: skip
    padded = -(-n // LANES) * LANES
    vectors = torch.empty(6, padded, dtype=dtype)
    vectors.numpy()[:] = 0
    start, level, *others = vectors
    level.numpy()[:n] = start.numpy()[:n] = prior.reshape(-1)
    sums, squares = torch.empty(2, n + width + 1, 4, dtype=dtype)
    around = torch.empty(n, 4, dtype=dtype)
    around.numpy()[:] = 0
    views = [(a, a.view(-1, LANES)) for a in others]
    _solve(
        width, count, own, corner, bilinear, change, start.view(-1, LANES), prior_weight, huber,
        iterations, reweightings, level, level.view(-1, LANES), weight,
        around, sums, squares, *(a for pair in views for a in pair),
    )  # fmt: skip
    return level.numpy()[:n].reshape(height, width)


def compile_kernels() -> None:
    """Compile what a solution needs, so that the first frames of a sequence need not wait for it."""
    image = np.ones((3, 3), np.float32)
    solve_brightness_image(
        image, (1.0, 1.0, 0.0, 0.0), np.eye(4)[None], image[None], image[None], image, 1.0, 1.0, 1, 0
    )
