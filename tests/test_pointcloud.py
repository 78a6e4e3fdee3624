"""Depth to points, and their spacing."""

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.pointcloud import SMALLEST_SCALE, depth_to_points, nearest_neighbour_scales

CAMERA = Camera(width=8, height=6, fx=7.0, fy=9.0, cx=3.25, cy=2.5)


def random_depth(seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    depth = random.uniform(0.5, 4.0, CAMERA.shape).astype(np.float32)
    depth[random.random(CAMERA.shape) < 0.3] = 0
    return depth


def pose() -> np.ndarray:
    T = np.eye(4)
    c, s = np.cos(0.7), np.sin(0.7)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T[:3, 3] = [1.0, -2.0, 0.5]
    return T


def test_points_are_depth_times_the_ray_of_their_pixel() -> None:
    depth, T = random_depth(), pose()
    points, pixels = depth_to_points(depth, CAMERA, T)
    x, y = pixels.T
    expected = (depth[..., None] * CAMERA.rays())[y, x] @ T[:3, :3].T + T[:3, 3]
    assert len(points) == np.count_nonzero(depth)
    np.testing.assert_allclose(points, expected, atol=1e-5)  # float32 of metres


def test_depth_of_the_principal_point_lies_on_the_optical_axis() -> None:
    camera = Camera(width=5, height=5, fx=4.0, fy=4.0, cx=2.0, cy=1.0)
    depth = np.zeros(camera.shape, np.float32)
    depth[1, 2] = 3.0  # pixel centres are at integer coordinates
    points, pixels = depth_to_points(depth, camera, np.eye(4))
    np.testing.assert_allclose(points, [[0, 0, 3]])
    assert pixels.tolist() == [[2, 1]]


def test_masked_missing_and_infinite_pixels_give_no_points() -> None:
    depth = random_depth()
    depth[0, :3] = [np.nan, np.inf, -1.0]
    mask = np.arange(depth.size).reshape(depth.shape) % 2 == 0
    _, pixels = depth_to_points(depth, CAMERA, pose(), mask)
    x, y = pixels.T
    assert mask[y, x].all()
    assert np.isfinite(depth[y, x]).all()
    assert len(pixels) == np.count_nonzero(mask & np.isfinite(depth) & (depth > 0))


def test_no_usable_depth_gives_empty_arrays() -> None:
    points, pixels = depth_to_points(np.zeros(CAMERA.shape, np.float32), CAMERA, np.eye(4))
    assert points.shape == (0, 3)
    assert pixels.shape == (0, 2)


def test_depth_of_another_size_is_an_error() -> None:
    with pytest.raises(DataError, match=r"depth: expected shape \(6, 8\) .* got \(8, 6\)"):
        depth_to_points(random_depth().T, CAMERA, np.eye(4))


def test_spacing_of_a_grid_is_its_step() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(5) * 0.05] * 3), -1).reshape(-1, 3)
    np.testing.assert_allclose(nearest_neighbour_scales(grid), 0.05, rtol=1e-4)


def test_spacing_is_the_mean_of_the_nearest_distances() -> None:
    points = np.random.default_rng(1).normal(size=(40, 3)).astype(np.float32)
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    expected = np.sort(distances, axis=1)[:, 1:4].mean(1)
    np.testing.assert_allclose(nearest_neighbour_scales(points), expected, rtol=1e-4)


def test_coinciding_points_keep_a_positive_scale() -> None:
    scales = nearest_neighbour_scales(np.ones((3, 3)))
    np.testing.assert_allclose(scales, SMALLEST_SCALE)


def test_a_single_point_has_no_spacing() -> None:
    with pytest.raises(DataError, match="at least 2"):
        nearest_neighbour_scales(np.zeros((1, 3)))
