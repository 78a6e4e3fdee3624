"""New Gaussians: where Eq. 13 places them, and their shape, discs on the measured surface."""

from dataclasses import dataclass

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.config import MappingConfig
from edslam_ti.depth_images import beside_steps, is_smooth, with_holes_filled
from edslam_ti.errors import DataError
from edslam_ti.geometry import inverse
from edslam_ti.mapping.budget import stride_for_budget
from edslam_ti.open3d_loader import load_open3d

FINER = 2  # near depth edges new Gaussians are this many times closer: coarse ones would show on both sides
FLATNESS = 0.2  # thickness of a new Gaussian, as a share of its width
MAX_ELONGATION = 4.0  # length over width of a new Gaussian on a slanted surface
FARTHEST = 1e4  # metres; larger readings are errors of the file, not distances


@dataclass(frozen=True)
class NewGaussians:
    """Gaussians to be added, without their brightness."""

    means: np.ndarray  # [N, 3] float32 metres, world
    pixels: np.ndarray  # [N, 2] int64 (x, y) that they are from
    quats: np.ndarray  # [N, 4] float32 wxyz
    scales: np.ndarray  # [N, 3] float32 metres
    is_measured: np.ndarray  # [N] bool: at measured depth, not at depth assumed in a hole


def new_gaussians(
    depth: np.ndarray,  # [H, W] float32 metres, 0 = missing
    alpha: np.ndarray,  # [H, W] of the map rendered from this pose
    rendered_depth: np.ndarray,  # [H, W] metres, of that view
    camera: Camera,
    T_world_camera: np.ndarray,  # [4, 4]
    count: int,  # Gaussians in the map so far
    config: MappingConfig,
) -> NewGaussians | None:
    """Return Gaussians at the pixels that Eq. 13 selects, one per stride x stride block, closer at edges.

    Pixels without depth get Gaussians at an assumed depth where the map shows nothing. None: there is nothing
    to add, or the map is full.
    """
    mask = densify_mask(alpha, rendered_depth, depth, config.min_visibility, config.depth_error_factor)
    mask |= (depth <= 0) & (alpha < config.min_visibility)
    is_measured, depth = depth > 0, with_holes_filled(depth)
    stride = stride_for_budget(config.pixel_stride, count / config.max_gaussians)
    spacing = np.where(beside_steps(depth), max(stride // FINER, 1), stride)
    points, pixels = depth_to_points(depth, camera, T_world_camera, mask & spaced(spacing))
    remaining = config.max_gaussians - count
    points, pixels = points[:remaining], pixels[:remaining]
    if len(points) == 0:
        return None
    x, y = pixels[:, 0], pixels[:, 1]
    # Discs start small: growing is faster than shrinking, and Eq. 13 fills the gaps between them.
    size = config.initial_size * spacing[y, x] * depth[y, x] / camera.fx
    quats, elongation = surface_discs(depth, camera, T_world_camera, pixels, MAX_ELONGATION)
    scales = size[:, None] * np.stack([np.ones_like(size), elongation, np.full_like(size, FLATNESS)], 1)
    means = points.astype(np.float32)
    return NewGaussians(means, pixels, quats, scales.astype(np.float32), is_measured[y, x])


def densify_mask(
    alpha: np.ndarray,  # [H, W] rendered
    rendered_depth: np.ndarray,  # [H, W] metres
    depth: np.ndarray,  # [H, W] metres, 0 = missing
    min_visibility: float,  # lambda_V
    depth_error_factor: float,  # lambda_MDE
) -> np.ndarray:  # [H, W] bool
    """Return the pixels where new Gaussians are needed and can be placed, Eq. 13."""
    valid = depth > 0
    if not valid.any():
        return valid
    error = np.abs(rendered_depth - depth)
    seen = valid & (alpha >= min_visibility)
    median_error = float(np.median(error[seen])) if seen.any() else np.inf
    return valid & ((alpha < min_visibility) | (error > depth_error_factor * median_error))


def spaced(
    spacing: np.ndarray,  # [H, W] int, pixels
) -> np.ndarray:  # [H, W] bool
    """Return one pixel of every block of spacing x spacing pixels."""
    y, x = np.ogrid[: spacing.shape[0], : spacing.shape[1]]
    return (y % spacing == spacing // 2) & (x % spacing == spacing // 2)


def depth_to_points(
    depth: np.ndarray,  # [H, W] float32 metres, 0 = missing
    camera: Camera,
    T_world_camera: np.ndarray,  # [4, 4]
    mask: np.ndarray | None = None,  # [H, W] bool, pixels to use; None = all
) -> tuple[np.ndarray, np.ndarray]:  # [N, 3] float32 metres, world; [N, 2] int64 (x, y)
    """Return the world points of the pixels with depth, row by row, and those pixels.

    The legacy point cloud keeps the order of the pixels; Open3D's tensor one does not.
    """
    _check_image("depth", depth, camera)
    # Comparisons with NaN are false: such pixels count as missing.
    used = (depth > 0) & (depth < FARTHEST)
    if mask is not None:
        _check_image("mask", mask, camera)
        used &= mask
    o3d = load_open3d()
    cloud = o3d.geometry.PointCloud.create_from_depth_image(
        o3d.geometry.Image(np.ascontiguousarray(np.where(used, depth, 0), np.float32)),
        o3d.camera.PinholeCameraIntrinsic(camera.width, camera.height, *camera.intrinsics),
        inverse(T_world_camera),
        depth_scale=1.0,
        depth_trunc=2 * FARTHEST,
    )
    points = np.asarray(cloud.points, dtype=np.float32).reshape(-1, 3)
    y, x = np.nonzero(used)
    return points, np.stack([x, y], -1)


def surface_discs(
    depth: np.ndarray,  # [H, W] float32 metres, 0 = missing
    camera: Camera,
    T_world_camera: np.ndarray,  # [4, 4]
    pixels: np.ndarray,  # [N, 2] int64 (x, y)
    max_elongation: float,
) -> tuple[np.ndarray, np.ndarray]:  # [N, 4] float32 wxyz; [N] float32 >= 1
    """Return the orientation and elongation of discs that lie on the surface and look circular.

    The third axis is the normal. The disc is longer along the second axis, by 1 / cosine of the tilt. Where a
    neighbour's depth is missing or jumps, the disc faces the camera.
    """
    from scipy.spatial.transform import Rotation

    _check_image("depth", depth, camera)
    x, y = pixels.T
    all_rays = camera.rays()
    points = all_rays * depth[..., None]
    rays = _unit(all_rays[y, x])
    normal = np.cross(_differences(points, depth, 1)[y, x], _differences(points, depth, 0)[y, x])
    is_known = np.linalg.norm(normal, axis=-1, keepdims=True) > 1e-12
    normal = _unit(np.where(is_known, normal, rays))
    cosine = np.abs((normal * rays).sum(-1))
    first = np.cross(normal, rays)
    faces_camera = np.linalg.norm(first, axis=-1, keepdims=True) < 1e-3  # any first axis will do
    first = _unit(np.where(faces_camera, np.cross(normal, [0.0, 1.0, 0.0]), first))
    axes = np.stack([first, np.cross(normal, first), normal], -1)
    x, y, z, w = Rotation.from_matrix(T_world_camera[:3, :3] @ axes).as_quat().T
    elongation = 1 / np.maximum(cosine, 1 / max_elongation)
    return np.stack([w, x, y, z], -1).astype(np.float32), elongation.astype(np.float32)


def _unit(vectors: np.ndarray) -> np.ndarray:  # [N, 3]
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _differences(points: np.ndarray, depth: np.ndarray, axis: int) -> np.ndarray:  # [H, W, 3]
    """Return the difference of each point's two neighbours; 0 at the border and where depth ends or jumps."""
    result = np.zeros_like(points)
    inner, before, after = ([slice(None), slice(None)] for _ in range(3))
    inner[axis], before[axis], after[axis] = slice(1, -1), slice(None, -2), slice(2, None)
    a, b, c = (depth[tuple(where)] for where in (before, inner, after))
    goes_on = is_smooth(a, b, c)
    result[tuple(inner)] = np.where(goes_on[..., None], points[tuple(after)] - points[tuple(before)], 0)
    return result


def _check_image(name: str, image: np.ndarray, camera: Camera) -> None:
    if image.shape != camera.shape:
        raise DataError(f"{name}: expected shape {camera.shape} as the camera's, got {image.shape}")
