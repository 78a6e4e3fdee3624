"""Equations 3 to 5 by themselves, for tests: kernels around the functions that the tracker's kernel calls."""

import numpy as np

from edslam_ti.geometry import adjoint
from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.patch_warp import (
    NEAR,
    Alignment,
    Direction,
    NormalEquations,
    Patches,
    ResidualModel,
    sample_bilinear,
    warp,
)


@ti.kernel
def _warp(
    pixels: ti.types.ndarray(ndim=2),  # [M, 3] x, y, inverse depth (0 = none)
    T: ti.types.ndarray(ndim=1),  # [12] rows of T_b_a
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
            X, Y = (pixels[m, 0] - cx) / fx * z, (pixels[m, 1] - cy) / fy * z
            rows = [T[k] for k in range(12)]
            _, _, p_z, _, x, y = warp(rows, X, Y, z, fx, fy, cx, cy)
            if p_z > NEAR:
                warped[m, 0], warped[m, 1], warped[m, 2] = x, y, p_z


@ti.kernel
def _sample(
    image: ti.types.ndarray(ndim=2),  # [H, W]
    points: ti.types.ndarray(ndim=2),  # [M, 2 or more] x, y, ...
    values: ti.types.ndarray(ndim=1),  # out [M]
    inside: ti.types.ndarray(ti.u8, ndim=1),  # out [M]
):
    for m in range(points.shape[0]):
        x, y = points[m, 0], points[m, 1]
        values[m], inside[m] = 0.0, ti.cast(0, ti.u8)
        if x >= 0 and x < image.shape[1] - 1 and y >= 0 and y < image.shape[0] - 1:
            i, j = ti.cast(ti.floor(y), ti.i32), ti.cast(ti.floor(x), ti.i32)
            corners = [image[i, j], image[i, j + 1], image[i + 1, j], image[i + 1, j + 1]]
            value, _, _ = sample_bilinear(corners, x - j, y - i)
            values[m], inside[m] = value, ti.cast(1, ti.u8)


def warped_pixels(
    pixels: np.ndarray,  # [M, 3] x, y, inverse depth (0 = none)
    T_b_a: np.ndarray,  # [4, 4]
    intrinsics: tuple[float, float, float, float],
) -> np.ndarray:  # [M, 3] x', y', depth in view b (0 = not visible)
    """Return patch pixels of view a as seen in view b, Eq. 3."""
    result = np.empty_like(pixels)
    _warp(pixels, np.ascontiguousarray(T_b_a[:3].ravel(), pixels.dtype), *intrinsics, result)
    return result


def bilinear_samples(
    image: np.ndarray,  # [H, W] float
    points: np.ndarray,  # [M, >= 2] float: x, y
) -> tuple[np.ndarray, np.ndarray]:  # [M] values, [M] bool: inside
    """Return the image at sub-pixel points (Eq. 4); 0 outside."""
    values, inside = np.empty(len(points), image.dtype), np.empty(len(points), np.uint8)
    _sample(image, np.ascontiguousarray(points), values, inside)
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
    direction = Direction(patches.points(intrinsics), 0, model)
    (system,) = Alignment([direction], np.stack([surface, depth], -1)[None], intrinsics).linearise([T_b_a])
    # T_b_a exp(-xi) = exp(-Ad(T_b_a) xi) T_b_a
    return system.transformed(-adjoint(T_b_a)) if inverse else system
