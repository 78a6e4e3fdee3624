"""Draws the depth image of one camera into another camera.

The pixels of a depth image, joined where they lie on one surface, form a mesh. Its vertices are moved into
the other camera and its triangles drawn there. On a plane inverse depth w = 1 / z is linear in the image,

    w = sum_i b_i w_i,      b_i = barycentric weights in the image,

so that slanted surfaces are exact, and no holes appear where the other camera's pixels are finer. The largest
w of a pixel is kept (z-buffer). Cells with a step in depth are left out: nothing is known of what lies
between their corners. At last, pixels next to a nearer surface are removed: there the background may be seen
past an edge that is known to a pixel only, or through a hole in the nearer surface.
"""

import numpy as np

from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.runtime import check_shape

COVERED = 1e-4  # share of a triangle by which a pixel's centre may lie outside, against gaps between two


@ti.func
def _draw(a, b, c, inverse: ti.template()):
    """Draw a triangle with corners (u, v, w)."""
    height, width = inverse.shape[0], inverse.shape[1]
    left = ti.max(ti.ceil(ti.min(a[0], b[0], c[0]) - ti.f32(0.01)), 0.0)
    right = ti.min(ti.floor(ti.max(a[0], b[0], c[0]) + ti.f32(0.01)), ti.cast(width - 1, ti.f32))
    top = ti.max(ti.ceil(ti.min(a[1], b[1], c[1]) - ti.f32(0.01)), 0.0)
    bottom = ti.min(ti.floor(ti.max(a[1], b[1], c[1]) + ti.f32(0.01)), ti.cast(height - 1, ti.f32))
    if left <= right and top <= bottom:
        ux, uy, vx, vy = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
        area = ux * vy - uy * vx
        if ti.abs(area) > 1e-12:
            for y in range(ti.cast(top, ti.i32), ti.cast(bottom, ti.i32) + 1):
                for x in range(ti.cast(left, ti.i32), ti.cast(right, ti.i32) + 1):
                    px, py = ti.cast(x, ti.f32) - a[0], ti.cast(y, ti.f32) - a[1]
                    s = (px * vy - py * vx) / area
                    t = (ux * py - uy * px) / area
                    if s >= -COVERED and t >= -COVERED and s + t <= 1 + COVERED:
                        w = a[2] + s * (b[2] - a[2]) + t * (c[2] - a[2])
                        ti.atomic_max(inverse[y, x], w)


@ti.func
def _visible(point, depth: ti.f32) -> ti.f32:
    """Return the depth of a pixel, 0 where its point is not in front of the target."""
    return ti.select(point[2] > 0, depth, ti.f32(0.0))


@ti.func
def _is_one_surface(a: ti.f32, b: ti.f32, c: ti.f32, step: ti.f32) -> ti.i32:
    """Return whether three depths exist and differ by less than a share of the nearest one."""
    low = ti.min(a, b, c)
    return ti.cast(low > 0 and ti.max(a, b, c) - low < step * low, ti.i32)


@ti.kernel
def _draw_depth(
    # inputs
    depth: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [h, w] metres, 0 = missing
    rays: ti.types.ndarray(dtype=ti.f32, ndim=3),  # [h, w, 2] x / z, y / z; NaN = none
    transform: ti.types.matrix(3, 4, ti.f32),  # T_target_source
    intrinsics: ti.types.vector(4, ti.f32),  # of the target
    nearest: ti.f32,  # metres
    step: ti.f32,  # share of the depth
    # outputs
    points: ti.types.ndarray(dtype=ti.f32, ndim=3),  # [h, w, 3] u, v (target px), 1 / z (1 / m, 0 = missing)
    inverse: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [H, W] 1 / m, 0 = missing
    result: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [H, W] metres, 0 = missing
):
    for y, x in ti.ndrange(depth.shape[0], depth.shape[1]):
        z, w = depth[y, x], ti.f32(0.0)
        rx, ry = rays[y, x, 0], rays[y, x, 1]
        if z > 0 and rx == rx:
            p = transform @ ti.Vector([rx * z, ry * z, z, 1.0])
            if p[2] > nearest:
                w = 1.0 / p[2]
                points[y, x, 0] = intrinsics[0] * p[0] * w + intrinsics[2]
                points[y, x, 1] = intrinsics[1] * p[1] * w + intrinsics[3]
        points[y, x, 2] = w
    for y, x in inverse:
        inverse[y, x] = 0.0
    for y, x in ti.ndrange(depth.shape[0] - 1, depth.shape[1] - 1):
        a = ti.Vector([points[y, x, k] for k in range(3)])
        b = ti.Vector([points[y, x + 1, k] for k in range(3)])
        c = ti.Vector([points[y + 1, x, k] for k in range(3)])
        d = ti.Vector([points[y + 1, x + 1, k] for k in range(3)])
        za, zb = _visible(a, depth[y, x]), _visible(b, depth[y, x + 1])
        zc, zd = _visible(c, depth[y + 1, x]), _visible(d, depth[y + 1, x + 1])
        # The cell is cut along the diagonal from b to c, unless only the other one leaves something.
        first, second = _is_one_surface(za, zb, zc, step), _is_one_surface(zb, zc, zd, step)
        if first == 1 or second == 1:
            if first == 1:
                _draw(a, b, c, inverse)
            if second == 1:
                _draw(b, c, d, inverse)
        else:
            if _is_one_surface(za, zb, zd, step) == 1:
                _draw(a, b, d, inverse)
            if _is_one_surface(za, zc, zd, step) == 1:
                _draw(a, c, d, inverse)
    for y, x in result:
        w, z = inverse[y, x], ti.f32(0.0)
        if w > 0:
            near = w
            for dy, dx in ti.static(ti.ndrange((-1, 2), (-1, 2))):
                j, i = y + dy, x + dx
                if 0 <= j < result.shape[0] and 0 <= i < result.shape[1]:
                    near = ti.max(near, inverse[j, i])
            if near - w < step * w:
                z = 1.0 / w
        result[y, x] = z


def draw_depth(
    depth: np.ndarray,  # [h, w] float32 metres, 0 = missing
    rays: np.ndarray,  # [h, w, 2] float32, x / z and y / z of its pixels, NaN = none
    T_target_source: np.ndarray,  # [4, 4]
    intrinsics: tuple[float, float, float, float],  # of the target: fx, fy, cx, cy in pixels
    shape: tuple[int, int],  # (H, W) of the target
    nearest: float,  # metres: what is nearer to the target is left out
    step: float,  # depths that differ by less than this share lie on one surface
) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
    """Return the depth image as another camera, a pinhole camera, would have measured it."""
    check_shape("rays", rays, (*depth.shape, 2))
    points = np.empty((*depth.shape, 3), np.float32)
    inverse, result = np.empty(shape, np.float32), np.empty(shape, np.float32)
    _draw_depth(
        np.ascontiguousarray(depth, np.float32), rays,
        ti.Matrix(T_target_source[:3].astype(np.float32).tolist()), ti.Vector([float(v) for v in intrinsics]),
        nearest, step, points, inverse, result,
    )  # fmt: skip
    return result
