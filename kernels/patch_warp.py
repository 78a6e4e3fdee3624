"""Patches of a time surface, their warp into another view, and the normal equations of alignment.

A patch pixel is (x, y, rho) with inverse depth rho (Eq. 2; rho = 0: no depth, left out). With
T = T_b_a, K the pinhole projection pi and S bilinear sampling:

    p' = T pi^-1(x, y, 1/rho),  x' = pi(p')          warp from view a to view b, Eq. 3
    r_surface = S(surface_b, x') - value             Eq. 4-5
    r_depth   = p'_z - S(depth_b, x')                projective depth residual

Both residuals are divided by their standard deviation and weighted by Huber's function; Eq. 5 sums
unsquared norms, and this is its smooth least-squares form. The unknown is a twist xi, order
(translation, rotation), that updates T_b_a <- exp(xi) T_b_a. Aligning b's patches to view a uses the
inverse transform with the same unknown, so that both directions add up in one system.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from kernels.runtime import check_shape

PARTS = 1024  # partial sums, in a fixed partition: the same bits for any number of threads
NEAR = 0.05  # metres
# Columns of a partial sum: 21 entries of H (upper triangle, row by row), 6 of g, then
COST, NUM_SURFACE, NUM_DEPTH, NUM_USABLE = 27, 28, 29, 30
SUM_SIZE = 31


@ti.func
def bilinear(image: ti.template(), x, y):
    """Value and gradient (per pixel) at (x, y), and the least of the four corners; all inside."""
    i, j = ti.cast(ti.floor(y), ti.i32), ti.cast(ti.floor(x), ti.i32)
    fx, fy = x - j, y - i
    a, b = image[i, j], image[i, j + 1]
    c, d = image[i + 1, j], image[i + 1, j + 1]
    top, bottom = a + fx * (b - a), c + fx * (d - c)
    gradient = ti.Vector([(1 - fy) * (b - a) + fy * (d - c), bottom - top])
    lowest = ti.min(ti.min(a, b), ti.min(c, d))
    highest = ti.max(ti.max(a, b), ti.max(c, d))
    return top + fy * (bottom - top), gradient, lowest, highest


@ti.func
def is_inside(x, y, height, width):
    return x >= 0 and x < width - 1 and y >= 0 and y < height - 1


@ti.func
def transform(T: ti.template(), p):
    return ti.Vector(
        [
            T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3],
            T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3],
            T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3],
        ]
    )


@ti.kernel
def _extract_patches(
    surface: ti.types.ndarray(ndim=2),  # [H, W]
    depth: ti.types.ndarray(ndim=2),  # [H, W] metres, 0 = missing
    centres: ti.types.ndarray(ti.i32, ndim=2),  # [P, 2] x, y
    size: ti.i32,
    pixels: ti.types.ndarray(ndim=2),  # out [P * size^2, 3]
    values: ti.types.ndarray(ndim=1),  # out [P * size^2]
):
    for m in range(values.shape[0]):
        patch, k = m // (size * size), m % (size * size)
        x = centres[patch, 0] + k % size - size // 2
        y = centres[patch, 1] + k // size - size // 2
        pixels[m, 0], pixels[m, 1], pixels[m, 2] = x, y, 0.0
        values[m] = 0.0
        if x >= 0 and x < surface.shape[1] and y >= 0 and y < surface.shape[0]:
            values[m] = surface[y, x]
            if depth[y, x] > NEAR:
                pixels[m, 2] = 1.0 / depth[y, x]


@ti.kernel
def _warp_pixels(
    pixels: ti.types.ndarray(ndim=2),  # [M, 3] x, y, inverse depth (0 = none)
    T_b_a: ti.types.ndarray(ndim=2),  # [4, 4]
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    warped: ti.types.ndarray(ndim=2),  # out [M, 3] x', y', depth in b (0 = not visible)
):
    for m in range(pixels.shape[0]):
        warped[m, 0], warped[m, 1], warped[m, 2] = 0.0, 0.0, 0.0
        if pixels[m, 2] > 0:
            z = 1.0 / pixels[m, 2]
            p = transform(T_b_a, ti.Vector([(pixels[m, 0] - cx) / fx * z, (pixels[m, 1] - cy) / fy * z, z]))
            if p[2] > NEAR:
                warped[m, 0], warped[m, 1] = fx * p[0] / p[2] + cx, fy * p[1] / p[2] + cy
                warped[m, 2] = p[2]


@ti.kernel
def _sample_bilinear(
    image: ti.types.ndarray(ndim=2),  # [H, W]
    points: ti.types.ndarray(ndim=2),  # [M, 2 or more] x, y, ...
    values: ti.types.ndarray(ndim=1),  # out [M]
    inside: ti.types.ndarray(ti.u8, ndim=1),  # out [M]
):
    for m in range(points.shape[0]):
        values[m], inside[m] = 0.0, ti.cast(0, ti.u8)
        if is_inside(points[m, 0], points[m, 1], image.shape[0], image.shape[1]):
            value, _, _, _ = bilinear(image, points[m, 0], points[m, 1])
            values[m], inside[m] = value, ti.cast(1, ti.u8)


@ti.func
def huber(r, threshold):
    """Huber weight and cost of a normalised residual."""
    size = ti.abs(r)
    weight, cost = 1.0, 0.5 * r * r
    if size > threshold:
        weight, cost = threshold / size, threshold * (size - 0.5 * threshold)
    return weight, cost


@ti.kernel
def _normal_equations(
    # inputs
    pixels: ti.types.ndarray(ndim=2),  # [M, 3] patch pixels of view a
    values: ti.types.ndarray(ndim=1),  # [M] their surface values
    surface: ti.types.ndarray(ndim=2),  # [H, W] of view b
    depth: ti.types.ndarray(ndim=2),  # [H, W] of view b, metres, 0 = missing
    T_b_a: ti.types.ndarray(ndim=2),  # [4, 4]
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    max_depth_difference: float,  # tau_d, metres
    surface_sigma: float,  # standard deviation of r_surface
    depth_weight: float,  # weight of r_depth, 0 = surface only
    depth_sigma: float,  # metres: standard deviation of depth is depth_sigma + depth_sigma_2 z^2
    depth_sigma_2: float,  # per metre
    huber_threshold: float,
    # outputs
    sums: ti.types.ndarray(ndim=2),  # [PARTS, SUM_SIZE]
    is_inverse: ti.template(),  # 1: the unknown updates T_a_b instead (reverse direction)
):
    height, width = surface.shape[0], surface.shape[1]
    n = pixels.shape[0]
    for part in range(PARTS):
        total = ti.Vector([0.0 for _ in range(SUM_SIZE)])
        for m in range(n * part // PARTS, n * (part + 1) // PARTS):
            if pixels[m, 2] > 0:
                total[NUM_USABLE] += 1
                z_a = 1.0 / pixels[m, 2]
                p_a = ti.Vector([(pixels[m, 0] - cx) / fx * z_a, (pixels[m, 1] - cy) / fy * z_a, z_a])
                p = transform(T_b_a, p_a)
                inv_z = 1.0 / ti.max(p[2], NEAR)
                x, y = fx * p[0] * inv_z + cx, fy * p[1] * inv_z + cy
                if p[2] > NEAR and is_inside(x, y, height, width):
                    value, gradient, _, _ = bilinear(surface, x, y)
                    d, d_gradient, d_low, d_high = bilinear(depth, x, y)
                    has_depth = d_low > NEAR
                    r_depth = p[2] - d
                    # tau_d: the depth check of Sec. III-B; without depth in b there is nothing to check.
                    if not has_depth or ti.abs(r_depth) < max_depth_difference:
                        # dx'/dp' and then dp'/dxi: [I | -[p']_x] forwards. Backwards, p' = T_b_a
                        # exp(-xi) p_a, so dp'/dxi = -R_b_a [I | -[p_a]_x].
                        du = ti.Vector([fx * inv_z, 0.0, -fx * p[0] * inv_z * inv_z])
                        dv = ti.Vector([0.0, fy * inv_z, -fy * p[1] * inv_z * inv_z])
                        along = gradient[0] * du + gradient[1] * dv
                        along_depth = ti.Vector([0.0, 0.0, 1.0]) - d_gradient[0] * du - d_gradient[1] * dv
                        s = p
                        if ti.static(is_inverse == 1):
                            R = ti.Matrix([[T_b_a[i, j] for j in range(3)] for i in range(3)])
                            along, along_depth = -(R.transpose() @ along), -(R.transpose() @ along_depth)
                            s = p_a
                        turn = s.cross(along)  # row vector times -[s]_x
                        J = ti.Vector([along[0], along[1], along[2], turn[0], turn[1], turn[2]])
                        J /= surface_sigma
                        r = (value - values[m]) / surface_sigma
                        weight, cost = huber(r, huber_threshold)
                        total[COST] += cost
                        total[NUM_SURFACE] += 1
                        for a in ti.static(range(6)):
                            total[21 + a] += weight * J[a] * r
                            for b in ti.static(range(a, 6)):
                                total[ti.static(a * 6 - a * (a - 1) // 2 + b - a)] += weight * J[a] * J[b]
                        # A depth edge between the four corners says nothing about the surface.
                        if has_depth and depth_weight > 0 and d_high - d_low < 0.05 * d_high:
                            sigma = depth_sigma + depth_sigma_2 * p[2] * p[2]
                            turn_depth = s.cross(along_depth)
                            for a in ti.static(range(3)):
                                J[a], J[a + 3] = along_depth[a] / sigma, turn_depth[a] / sigma
                            r = r_depth / sigma
                            weight, cost = huber(r, huber_threshold)
                            weight *= depth_weight
                            total[COST] += depth_weight * cost
                            total[NUM_DEPTH] += 1
                            for a in ti.static(range(6)):
                                total[21 + a] += weight * J[a] * r
                                for b in ti.static(range(a, 6)):
                                    total[ti.static(a * 6 - a * (a - 1) // 2 + b - a)] += weight * J[a] * J[b]
        for k in ti.static(range(SUM_SIZE)):
            sums[part, k] = total[k]


@dataclass(frozen=True)
class Patches:
    """Square patches of one view (Eq. 2), flattened: M = number of patches times size^2."""

    pixels: np.ndarray  # [M, 3] float: x, y, inverse depth in 1/m (0 = no depth: left out)
    values: np.ndarray  # [M] float: surface values


@dataclass(frozen=True)
class ResidualModel:
    """How residuals are weighted against each other."""

    max_depth_difference: float = 0.1  # tau_d, metres
    surface_sigma: float = 0.15
    depth_weight: float = 1.0
    depth_sigma: float = 0.003  # metres
    depth_sigma_2: float = 0.0019  # 1/m: the standard deviation grows by this times z^2
    huber_threshold: float = 1.345


@dataclass(frozen=True)
class NormalEquations:
    """H xi = -g for the twist xi that updates T_b_a <- exp(xi) T_b_a, and what went into it."""

    H: np.ndarray  # [6, 6] float64
    g: np.ndarray  # [6] float64
    cost: float  # sum of robust costs
    num_surface: int  # pixels with a surface residual
    num_depth: int  # pixels with a depth residual
    num_usable: int  # patch pixels that have depth, visible in the other view or not

    def __add__(self, other: "NormalEquations") -> "NormalEquations":
        return NormalEquations(
            self.H + other.H,
            self.g + other.g,
            self.cost + other.cost,
            self.num_surface + other.num_surface,
            self.num_depth + other.num_depth,
            self.num_usable + other.num_usable,
        )


def extract_patches(
    surface: np.ndarray,  # [H, W] float
    depth: np.ndarray,  # [H, W] float metres, 0 = missing
    centres: np.ndarray,  # [P, 2] int32, x and y
    size: int,  # odd, pixels
) -> Patches:
    """Return the patches around the centres (Eq. 2); pixels outside the image have no depth."""
    check_shape("depth", depth, surface.shape)
    check_shape("centres", centres, (None, 2))
    if size < 1 or size % 2 == 0:
        raise ValueError(f"size: expected an odd number of pixels, got {size}")
    m = len(centres) * size * size
    pixels, values = np.empty((m, 3), surface.dtype), np.empty(m, surface.dtype)
    if m:
        _extract_patches(surface, depth, np.ascontiguousarray(centres, np.int32), size, pixels, values)
    return Patches(pixels, values)


def warp_pixels(
    pixels: np.ndarray,  # [M, 3] x, y, inverse depth (0 = none)
    T_b_a: np.ndarray,  # [4, 4]
    intrinsics: tuple[float, float, float, float],
) -> np.ndarray:  # [M, 3] x', y', depth in view b (0 = not visible)
    """Return patch pixels of view a as seen in view b, Eq. 3."""
    check_shape("pixels", pixels, (None, 3))
    check_shape("T_b_a", T_b_a, (4, 4))
    warped = np.empty_like(pixels)
    _warp_pixels(pixels, np.ascontiguousarray(T_b_a, pixels.dtype), *intrinsics, warped)
    return warped


def sample_bilinear(
    image: np.ndarray,  # [H, W] float
    points: np.ndarray,  # [M, >= 2] float: x, y
) -> tuple[np.ndarray, np.ndarray]:  # [M] values, [M] bool: inside
    """Return the image at sub-pixel points by bilinear interpolation (Eq. 4); 0 outside."""
    values, inside = np.empty(len(points), image.dtype), np.empty(len(points), np.uint8)
    _sample_bilinear(image, np.ascontiguousarray(points), values, inside)
    return values, inside.astype(bool)


def normal_equations(
    patches: Patches,  # of view a
    surface: np.ndarray,  # [H, W] of view b
    depth: np.ndarray,  # [H, W] of view b, metres, 0 = missing
    T_b_a: np.ndarray,  # [4, 4]
    intrinsics: tuple[float, float, float, float],
    model: ResidualModel,
    inverse: bool = False,
) -> NormalEquations:
    """Return the Gauss-Newton system of Eq. 5, one direction: patches of view a against view b.

    `inverse`: the unknown updates T_a_b <- exp(xi) T_a_b, to be added to the forward direction's.
    """
    check_shape("depth", depth, surface.shape)
    check_shape("T_b_a", T_b_a, (4, 4))
    dtype = patches.pixels.dtype
    sums = np.empty((PARTS, SUM_SIZE), dtype)
    _normal_equations(
        patches.pixels, patches.values, surface, depth, np.ascontiguousarray(T_b_a, dtype), *intrinsics,
        model.max_depth_difference, model.surface_sigma, model.depth_weight, model.depth_sigma,
        model.depth_sigma_2, model.huber_threshold, sums, int(inverse),
    )  # fmt: skip
    total = sums.sum(0, dtype=np.float64)
    H = np.zeros((6, 6))
    H[np.triu_indices(6)] = total[:21]
    H = H + H.T - np.diag(np.diag(H))
    counts = (int(total[k]) for k in (NUM_SURFACE, NUM_DEPTH, NUM_USABLE))
    return NormalEquations(H, total[21:27].copy(), float(total[COST]), *counts)
