"""Twin of depth_drawing.py: the same result, triangle by triangle, written to be read."""

import itertools

import numpy as np

from edslam_ti.kernels.depth_drawing import COVERED


def draw_depth(
    depth: np.ndarray,  # [h, w] metres, 0 = missing
    rays: np.ndarray,  # [h, w, 2]
    T_target_source: np.ndarray,  # [4, 4]
    intrinsics: tuple[float, float, float, float],
    shape: tuple[int, int],
    nearest: float,
    step: float,
) -> np.ndarray:  # [H, W] metres, 0 = missing
    """Return the depth image as another camera, a pinhole camera, would have measured it."""
    fx, fy, cx, cy = intrinsics
    homogeneous = np.concatenate([rays, np.ones((*depth.shape, 1))], -1) * depth[..., None]
    points = homogeneous @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    z = points[..., 2]
    exists = (depth > 0) & np.isfinite(rays).all(-1) & (z > nearest)
    source = np.where(exists, depth, 0)
    with np.errstate(all="ignore"):
        vertices = np.stack(
            [fx * points[..., 0] / z + cx, fy * points[..., 1] / z + cy, np.where(exists, 1 / z, 0)], -1
        )
    inverse = np.zeros(shape)
    for y, x in itertools.product(range(depth.shape[0] - 1), range(depth.shape[1] - 1)):
        cell = [(y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)]
        triangles = [t for t in ((0, 1, 2), (1, 2, 3)) if _is_one_surface(source, [cell[k] for k in t], step)]
        if not triangles:
            others = ((0, 1, 3), (0, 2, 3))
            triangles = [t for t in others if _is_one_surface(source, [cell[k] for k in t], step)]
        for triangle in triangles:
            _draw(np.array([vertices[cell[k]] for k in triangle]), inverse)
    result = np.zeros(shape, np.float32)
    for y, x in itertools.product(*map(range, shape)):
        near = inverse[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].max()
        w = inverse[y, x]
        if w > 0 and near - w < step * w:
            result[y, x] = 1 / w
    return result


def _is_one_surface(depth: np.ndarray, corners: list[tuple[int, int]], step: float) -> bool:
    z = [depth[corner] for corner in corners]
    return bool(min(z) > 0 and max(z) - min(z) < step * min(z))


def _draw(corners: np.ndarray, inverse: np.ndarray) -> None:  # [3, 3] u, v, w; [H, W], changed
    """Keep the larger inverse depth of the pixels whose centres lie in a triangle."""
    edges = (corners[1:] - corners[0])[:, :2].T
    if abs(np.linalg.det(edges)) <= 1e-12:
        return
    for y, x in itertools.product(*map(range, inverse.shape)):
        s, t = np.linalg.solve(edges, (x, y) - corners[0, :2])
        if min(s, t) >= -COVERED and s + t <= 1 + COVERED:
            w = corners[0, 2] + s * (corners[1, 2] - corners[0, 2]) + t * (corners[2, 2] - corners[0, 2])
            inverse[y, x] = max(inverse[y, x], w)
