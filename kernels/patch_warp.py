"""Patches of a time surface, their warp into another view, and the normal equations of alignment.

A patch pixel is (x, y, rho) with inverse depth rho (Eq. 2; rho = 0: no depth, left out). With
T = T_b_a, K the pinhole projection pi and S bilinear sampling:

    p' = T pi^-1(x, y, 1/rho),  x' = pi(p')          warp from view a to view b, Eq. 3
    r_surface = S(surface_b, x') - value             Eq. 4-5
    r_depth   = p'_z - S(depth_b, x')                projective depth residual

Both residuals are divided by their standard deviation and weighted by Huber's function; Eq. 5 sums
unsquared norms, and this is its smooth least-squares form. The unknown is a twist xi, order
(translation, rotation), that updates T_b_a <- exp(xi) T_b_a.

The inverse-compositional form (Baker and Matthews 2004) updates T_b_a <- T_b_a exp(xi). It uses the Jacobian
of the patches in their own view, which stays the same and equals that of the other view once they align:

    dr_surface/dxi = dS(surface_a, pi(exp(xi) p))/dxi,    dr_depth/dxi = d(p_z - S(depth_a, pi(p)))/dxi

One launch linearises all patches of all directions, sixteen pixels at a time (kernels.lanes). Points of view
a and their Jacobians are vectors; only the corners of the bilinear samples are fetched pixel by pixel.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from edslam_ti.kernels.constants import NEAR
from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.lanes import LANES, lanes, vector_instructions, zeros
from edslam_ti.kernels.runtime import CHUNK, check_shape, float_dtype, workers

PART = 32  # blocks of LANES pixels to a partial sum: a fixed partition, the same bits for any threads
PARTS_PER_WORKER = 24  # fewer are finished before another core has woken up
# Columns of a partial sum: 21 entries of H (upper triangle, row by row), 6 of g, then
COST, NUM_SURFACE, NUM_DEPTH, NUM_USABLE = 27, 28, 29, 30
SUM_SIZE = 31
# Columns of a job: T_b_a (three rows of four), then
FX, FY, CX, CY, MAX_DEPTH_DIFFERENCE, SURFACE_SIGMA = 12, 13, 14, 15, 16, 17
DEPTH_WEIGHT, DEPTH_SIGMA, DEPTH_SIGMA_2, HUBER_THRESHOLD = 18, 19, 20, 21
JOB_SIZE = 22
POINT_SIZE = 4  # X, Y, Z, value; then, in the compositional form, both residuals' Jacobians
# Share of the depth by which neighbouring pixels of one depth image may differ. A larger difference is an
# edge, across which interpolated depth lies on no surface. This constant compares measurements of one image;
# SAME_SURFACE and OCCLUDED of kernels.brightness_image compare a predicted depth with measured ones.
MAX_SLOPE = 0.05


@ti.func
def warp(T, X, Y, Z, fx, fy, cx, cy):
    """Eq. 3: p' = T p of view b (metres), 1 / p'_z, and its pixel x', y'; not visible if p'_z <= NEAR.

    T are the twelve numbers of T_b_a by rows, p = (X, Y, Z) is pi^-1 of a patch pixel of view a.
    """
    p_x = T[0] * X + T[1] * Y + T[2] * Z + T[3]
    p_y = T[4] * X + T[5] * Y + T[6] * Z + T[7]
    p_z = T[8] * X + T[9] * Y + T[10] * Z + T[11]
    inv_z = 1.0 / ti.max(p_z, NEAR)
    return p_x, p_y, p_z, inv_z, fx * p_x * inv_z + cx, fy * p_y * inv_z + cy


@ti.func
def sample_bilinear(corner, u, v):
    """Eq. 4: value and gradient at fractions (u, v) between the corners a b / c d of a square pixel."""
    a, b, c, d = corner[0], corner[1], corner[2], corner[3]
    top, bottom = a + u * (b - a), c + u * (d - c)
    along_x = (b - a) + v * ((d - c) - (b - a))
    return top + v * (bottom - top), along_x, bottom - top


@ti.func
def lowest_and_highest(corner):
    """The smallest and the largest of four corners."""
    a, b, c, d = corner[0], corner[1], corner[2], corner[3]
    return ti.min(ti.min(a, b), ti.min(c, d)), ti.max(ti.max(a, b), ti.max(c, d))


@ti.kernel
def _extract_patches(
    surface: ti.types.ndarray(ndim=2),  # [H, W]
    depth: ti.types.ndarray(ndim=2),  # [H, W] metres, 0 = missing
    centres: ti.types.ndarray(ti.i32, ndim=2),  # [P, 2] x, y
    size: ti.i32,
    pixels: ti.types.ndarray(ndim=2),  # out [P * size^2, 3]
    values: ti.types.ndarray(ndim=1),  # out [P * size^2]
):
    ti.loop_config(serialize=True)  # waking up a second core takes as long as this loop
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


@ti.func
def huber(r, threshold):
    """Huber weight and cost of normalised residuals."""
    size = ti.max(r, 0.0 - r)
    cut = ti.min(size, threshold)
    return cut / ti.max(size, 1e-12), cut * (size - 0.5 * cut)


@vector_instructions
@ti.kernel
def _linearise(
    # inputs
    points: lanes(2),  # [blocks, POINT_SIZE] X, Y, Z in view a (metres, Z = 0: none) and surface value
    images: ti.types.ndarray(ndim=1),  # [V * H * W * 2] surface and depth (metres, 0 = missing) of all views
    height: ti.i32,
    width: ti.i32,
    parts: ti.types.ndarray(ti.i32, ndim=2),  # [P, 4] first block, past the last, job, view
    jobs: ti.types.ndarray(ndim=2),  # [J, JOB_SIZE]
    num_workers: ti.i32,
    # outputs
    sums: ti.types.ndarray(ndim=2),  # [P, SUM_SIZE]
    is_compositional: ti.template(),
):
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w, num_parts = chunk // CHUNK, parts.shape[0]
            for part in range(num_parts * w // num_workers, num_parts * (w + 1) // num_workers):
                job, first_pixel = parts[part, 2], parts[part, 3] * height * width
                T = [jobs[job, k] for k in range(12)]
                fx, fy, cx, cy = jobs[job, FX], jobs[job, FY], jobs[job, CX], jobs[job, CY]
                surface_scale = zeros() + 1.0 / jobs[job, SURFACE_SIGMA]
                depth_weight = jobs[job, DEPTH_WEIGHT]
                threshold = jobs[job, HUBER_THRESHOLD]
                last_column, last_row = float(width - 1), float(height - 1)
                total = [zeros() for _ in range(SUM_SIZE)]
                for block in range(parts[part, 0], parts[part, 1]):
                    X, Y, Z, value = points[block, 0], points[block, 1], points[block, 2], points[block, 3]
                    p_x, p_y, p_z, inv_z, x, y = warp(T, X, Y, Z, fx, fy, cx, cy)
                    is_usable = Z > 0
                    inside = is_usable & (p_z > NEAR)
                    inside = inside & (x >= 0) & (x < last_column) & (y >= 0) & (y < last_row)
                    x, y = ti.select(inside, x, 0.0), ti.select(inside, y, 0.0)
                    column, row = ti.floor(x), ti.floor(y)
                    surface_corners = [zeros() for _ in range(4)]
                    depth_corners = [zeros() for _ in range(4)]
                    for lane in ti.static(range(LANES)):
                        pixel = ti.cast(row[lane], ti.i32) * width + ti.cast(column[lane], ti.i32)
                        above = 2 * (first_pixel + pixel)
                        place = [above, above + 2, above + 2 * width, above + 2 * width + 2]
                        for k in ti.static(range(4)):
                            surface_corners[k][lane] = images[place[k]]
                            depth_corners[k][lane] = images[place[k] + 1]
                    u, v = x - column, y - row
                    s, s_x, s_y = sample_bilinear(surface_corners, u, v)
                    d, d_x, d_y = sample_bilinear(depth_corners, u, v)
                    d_low, d_high = lowest_and_highest(depth_corners)
                    has_depth = d_low > NEAR
                    r_depth = p_z - d
                    # tau_d: the depth check of Sec. III-B; without depth in b there is nothing to check.
                    disagreement = ti.select(has_depth, ti.max(r_depth, d - p_z), 0.0)
                    keep = inside & (disagreement < jobs[job, MAX_DEPTH_DIFFERENCE])
                    is_smooth = keep & has_depth & (d_high - d_low < MAX_SLOPE * d_high)
                    depth_sigma = jobs[job, DEPTH_SIGMA] + jobs[job, DEPTH_SIGMA_2] * p_z * p_z
                    # dx'/dp' = [fx / z, 0, -fx x / z^2], [0, fy / z, -fy y / z^2]; dp'/dxi = [I | -[p']_x]
                    du, dv = fx * inv_z, fy * inv_z
                    du_z, dv_z = du * p_x * inv_z, dv * p_y * inv_z
                    for k in ti.static(range(2)):
                        g_x, g_y, g_z, r = s_x * du, s_y * dv, 0.0 - s_x * du_z - s_y * dv_z, s - value
                        scale, share, is_used, counted = surface_scale, 1.0, keep, 1.0
                        if ti.static(k == 1):
                            g_x, g_y, g_z = 0.0 - d_x * du, 0.0 - d_y * dv, 1.0 + d_x * du_z + d_y * dv_z
                            r, scale, is_used = r_depth, 1.0 / depth_sigma, is_smooth
                            share, counted = depth_weight, ti.select(depth_weight > 0, 1.0, 0.0)
                        J = [
                            g_x, g_y, g_z,
                            p_y * g_z - p_z * g_y, p_z * g_x - p_x * g_z, p_x * g_y - p_y * g_x,
                        ]  # fmt: skip
                        if ti.static(is_compositional):
                            for a in ti.static(range(6)):
                                J[a] = points[block, POINT_SIZE + 6 * k + a]
                        weight, cost = huber(r * scale, threshold)
                        total[COST] += ti.select(is_used, share * cost, 0.0)
                        total[NUM_SURFACE + k] += ti.select(is_used, counted, 0.0)
                        weight = ti.select(is_used, share * weight * scale * scale, 0.0)
                        for a in ti.static(range(6)):
                            weighted = weight * J[a]
                            total[21 + a] += weighted * r
                            for b in ti.static(range(a, 6)):
                                total[ti.static(a * 6 - a * (a - 1) // 2 + b - a)] += weighted * J[b]
                    total[NUM_USABLE] += ti.select(is_usable, 1.0, 0.0)
                for k in ti.static(range(SUM_SIZE)):
                    sums[part, k] = total[k].sum()


@dataclass(frozen=True)
class Patches:
    """Square patches of one view (Eq. 2), flattened: M = number of patches times size^2."""

    pixels: np.ndarray  # [M, 3] float: x, y, inverse depth in 1/m (0 = no depth: left out)
    values: np.ndarray  # [M] float: surface values

    def points(
        self,
        intrinsics: tuple[float, float, float, float],
        template: tuple[np.ndarray, np.ndarray] | None = None,  # surface and depth [H, W] of their own view
    ) -> torch.Tensor:  # [blocks, 4 or 16, LANES]
        """Return (X, Y, Z, value) in lanes: points in metres in the camera's frame, Z = 0 where unknown.

        With a template the Jacobians of the inverse-compositional form follow.
        """
        fx, fy, cx, cy = intrinsics
        x, y, rho = self.pixels.T
        m = len(rho)
        size = POINT_SIZE if template is None else POINT_SIZE + 12
        result = torch.empty(-(-m // LANES), size, LANES, dtype=float_dtype())
        rows = np.zeros((size, len(result) * LANES), result.numpy().dtype)
        np.divide(1, rho, out=rows[2, :m], where=rho > 0)
        rows[0, :m], rows[1, :m] = (x - cx) / fx * rows[2, :m], (y - cy) / fy * rows[2, :m]
        rows[3, :m] = self.values
        if template is not None:
            rows[POINT_SIZE:, :m] = _template_jacobians(self.pixels, rows[:3, :m], *template, intrinsics)
        result.numpy()[:] = rows.reshape(size, -1, LANES).swapaxes(0, 1)
        return result


def _template_jacobians(
    pixels: np.ndarray,  # [M, 3] x, y, inverse depth
    points: np.ndarray,  # [3, M] metres
    surface: np.ndarray,  # [H, W]
    depth: np.ndarray,  # [H, W] metres, 0 = missing
    intrinsics: tuple[float, float, float, float],
) -> np.ndarray:  # [12, M]
    """Return dr_surface/dxi and dr_depth/dxi by central differences; 0 at borders and depth edges."""
    (height, width), (fx, fy, _, _) = surface.shape, intrinsics
    column, row = pixels[:, 0].astype(np.intp), pixels[:, 1].astype(np.intp)
    inside = (column > 0) & (column < width - 1) & (row > 0) & (row < height - 1) & (pixels[:, 2] > 0)
    at = np.where(inside, row * width + column, width + 1)
    p = np.where(inside, points, 1.0).astype(points.dtype)
    du, dv = fx / p[2], fy / p[2]
    du_z, dv_z = du * p[0] / p[2], dv * p[1] / p[2]
    result = np.empty((2, 6, len(at)), points.dtype)
    for image, along_z, sign, J in ((surface, 0, 1, result[0]), (depth, 1, -1, result[1])):
        left, right, above, below = (image.ravel()[at + step] for step in (-1, 1, -width, width))
        along_x, along_y = sign * (right - left) / 2, sign * (below - above) / 2
        g = J[:3]
        g[0], g[1], g[2] = along_x * du, along_y * dv, along_z - along_x * du_z - along_y * dv_z
        J[3], J[4], J[5] = p[1] * g[2] - p[2] * g[1], p[2] * g[0] - p[0] * g[2], p[0] * g[1] - p[1] * g[0]
        J[:, ~inside] = 0
    neighbours = np.stack([left, right, above, below])  # of depth
    lowest, highest = neighbours.min(0), neighbours.max(0)
    result[1][:, (lowest <= NEAR) | (highest - lowest >= 2 * MAX_SLOPE * highest)] = 0
    return result.reshape(12, -1)


@dataclass(frozen=True)
class ResidualModel:
    """Weights of the residuals."""

    max_depth_difference: float = 0.1  # tau_d, metres
    surface_sigma: float = 0.15
    depth_weight: float = 1.0
    depth_sigma: float = 0.003  # metres
    depth_sigma_2: float = 0.0019  # 1/m: the standard deviation grows by this times z^2
    huber_threshold: float = 1.345


@dataclass(frozen=True)
class NormalEquations:
    """H xi = -g for a twist xi, with the cost and the numbers of residuals."""

    H: np.ndarray  # [6, 6] float64
    g: np.ndarray  # [6] float64
    cost: float  # sum of robust costs
    num_surface: int  # pixels with a surface residual
    num_depth: int  # pixels with a depth residual
    num_usable: int  # patch pixels with depth, visible in the other view or not

    def __add__(self, other: "NormalEquations") -> "NormalEquations":
        return NormalEquations(
            self.H + other.H,
            self.g + other.g,
            self.cost + other.cost,
            self.num_surface + other.num_surface,
            self.num_depth + other.num_depth,
            self.num_usable + other.num_usable,
        )

    def transformed(self, A: np.ndarray) -> "NormalEquations":  # [6, 6]
        """Return the system for the unknown xi', with xi = A xi'."""
        return replace(self, H=A.T @ self.H @ A, g=A.T @ self.g)


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


@dataclass(frozen=True)
class Direction:
    """Patches of one view that are aligned to the image of another."""

    points: torch.Tensor  # [blocks, 4 or 16, LANES], from `Patches.points`; all directions alike
    view: int  # index of the image
    model: ResidualModel


class Alignment:
    """Computes the normal equations of several directions at once, for poses that change with every call.

    The unknown is the twist xi with T_b_a <- exp(xi) T_b_a. If the points carry the Jacobians of a template
    (`is_compositional`), it is the xi with T_b_a <- T_b_a exp(xi).
    """

    def __init__(
        self,
        directions: list[Direction],
        views: np.ndarray,  # [V, H, W, 2] surface and depth (metres, 0 = missing)
        intrinsics: tuple[float, float, float, float],
    ) -> None:
        check_shape("views", views, (None, None, None, 2))
        self._views: np.ndarray = np.ascontiguousarray(views, _numpy_float())
        points = [direction.points.numpy() for direction in directions]
        rows = points[0].shape[1] if points else POINT_SIZE
        self.is_compositional = rows > POINT_SIZE
        if len(directions) == 1:
            self._points = directions[0].points
        else:
            self._points = torch.empty(sum(map(len, points)), rows, LANES, dtype=float_dtype())
            np.concatenate(points, out=self._points.numpy())  # torch.cat would wake up other cores
        self._jobs: np.ndarray = np.empty((len(directions), JOB_SIZE), _numpy_float())
        self._parts: list[slice] = []
        bounds: list[tuple[int, int, int, int]] = []
        begin = 0
        for job, direction in enumerate(directions):
            if not 0 <= direction.view < len(views):
                raise ValueError(f"view: expected 0 to {len(views) - 1}, got {direction.view}")
            past = begin + len(direction.points)
            self._parts.append(slice(len(bounds), len(bounds) + -(-(past - begin) // PART)))
            bounds += [(b, min(b + PART, past), job, direction.view) for b in range(begin, past, PART)]
            begin = past
            model = direction.model
            self._jobs[job, FX:] = (
                *intrinsics, model.max_depth_difference, model.surface_sigma,
                model.depth_weight, model.depth_sigma, model.depth_sigma_2, model.huber_threshold,
            )  # fmt: skip
        self._bounds = np.array(bounds, np.int32).reshape(-1, 4)
        self._sums: np.ndarray = np.empty((len(bounds), SUM_SIZE), _numpy_float())

    def linearise(self, poses: list[np.ndarray]) -> "list[NormalEquations]":  # T_b_a [4, 4] of each direction
        """Return the Gauss-Newton system of Eq. 5 for each direction, in the unknown named above."""
        for job, T_b_a in enumerate(poses):
            self._jobs[job, :FX] = T_b_a[:3].ravel()
        if len(self._bounds):
            height, width = self._views.shape[1:3]
            num_workers = min(workers(), 1 + len(self._bounds) // PARTS_PER_WORKER)
            _linearise(
                self._points, self._views.reshape(-1), height, width, self._bounds, self._jobs,
                num_workers, self._sums, self.is_compositional,
            )  # fmt: skip
        totals = [self._sums[parts].sum(0, dtype=np.float64) for parts in self._parts]
        return [
            NormalEquations(
                total[_SYMMETRIC], total[21:COST], float(total[COST]),
                int(total[NUM_SURFACE]), int(total[NUM_DEPTH]), int(total[NUM_USABLE]),
            )
            for total in totals
        ]  # fmt: skip


def compile_kernels() -> None:
    """Compile the kernels of tracking, so that the first frames of a sequence do not wait for it."""
    image: np.ndarray = np.zeros((2, 2), _numpy_float())
    patches = extract_patches(image, image, np.zeros((1, 2), np.int32), 1)
    intrinsics = (1.0, 1.0, 0.0, 0.0)
    direction = Direction(patches.points(intrinsics), 0, ResidualModel())
    Alignment([direction], np.zeros((1, 2, 2, 2)), intrinsics).linearise([np.eye(4)])


def _numpy_float() -> type:
    return np.float64 if float_dtype() == torch.float64 else np.float32


# Positions of the entries of H in a partial sum.
_SYMMETRIC = np.array(
    [[min(a, b) * 6 - min(a, b) * (min(a, b) - 1) // 2 + abs(a - b) for b in range(6)] for a in range(6)]
)
