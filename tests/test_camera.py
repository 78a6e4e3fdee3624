"""The pinhole camera, with pixel centres at integer coordinates."""

from typing import Any

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError

CAMERA = Camera(width=12, height=8, fx=10.0, fy=11.0, cx=5.25, cy=3.75)


def test_rays_project_to_the_pixels_they_come_from() -> None:
    rays = CAMERA.rays()
    assert rays.shape == (8, 12, 3)
    projected = rays @ CAMERA.matrix.T
    y, x = np.mgrid[0:8, 0:12]
    np.testing.assert_allclose(projected[..., 0], x, atol=1e-12)
    np.testing.assert_allclose(projected[..., 1], y, atol=1e-12)
    np.testing.assert_allclose(projected[..., 2], 1)


def test_back_projected_points_are_seen_where_they_came_from() -> None:
    u, v = np.array([0.0, 3.25, 11.0]), np.array([7.0, 2.5, 0.0])
    depth = np.array([0.5, 2.0, 3.0])
    points = CAMERA.back_project_pixels(u, v, depth)
    assert points.shape == (3, 3)
    for seen, expected in zip(CAMERA.project(points), (u, v, depth)):
        np.testing.assert_allclose(seen, expected, atol=1e-12)


def test_projection_agrees_with_the_intrinsic_matrix() -> None:
    points = np.random.default_rng(0).uniform(0.5, 2.0, (4, 5, 3))
    homogeneous = points @ CAMERA.matrix.T
    u, v, z = CAMERA.project(points)
    assert u.shape == (4, 5)
    np.testing.assert_allclose(u, homogeneous[..., 0] / homogeneous[..., 2])
    np.testing.assert_allclose(v, homogeneous[..., 1] / homogeneous[..., 2])
    np.testing.assert_array_equal(z, points[..., 2])


def test_points_behind_the_camera_keep_their_depth_and_stay_finite() -> None:
    u, v, z = CAMERA.project(np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0], [0.1, 0.2, 0.01]]), nearest=0.05)
    np.testing.assert_allclose(u, 10 * 0.1 / 0.05 + 5.25)
    np.testing.assert_allclose(v, 11 * 0.2 / 0.05 + 3.75)
    np.testing.assert_array_equal(z, [-1.0, 0.0, 0.01])


def test_only_pixels_with_depth_are_back_projected() -> None:
    depth = np.zeros(CAMERA.shape, np.float32)
    depth[2, 5], depth[6, 1] = 1.5, 3.0
    rays = CAMERA.rays()
    expected = np.stack([1.5 * rays[2, 5], 3.0 * rays[6, 1]])
    points = CAMERA.back_project(depth)
    assert points.dtype == np.float64
    np.testing.assert_array_equal(points, expected)
    np.testing.assert_array_equal(CAMERA.back_project(depth, mask=depth > 2), expected[1:])


def test_depth_of_another_size_is_refused() -> None:
    with pytest.raises(DataError, match=r"depth: expected shape \(8, 12\), got \(12, 8\)"):
        CAMERA.back_project(np.ones((12, 8)))


def test_ray_of_a_downscaled_pixel_is_the_mean_of_its_block() -> None:
    for factor in (2, 4):
        rays = CAMERA.rays()
        blocks = rays.reshape(8 // factor, factor, 12 // factor, factor, 3).mean((1, 3))
        np.testing.assert_allclose(CAMERA.downscaled(factor).rays(), blocks, atol=1e-12)


def test_downscaling_twice_by_two_is_once_by_four() -> None:
    twice, once = CAMERA.downscaled(2).downscaled(2), CAMERA.downscaled(4)
    assert twice.shape == once.shape
    np.testing.assert_allclose(twice.intrinsics, once.intrinsics)


def test_odd_edges_are_cut_off() -> None:
    assert Camera(width=13, height=9, fx=10, fy=10, cx=6, cy=4).downscaled(2).shape == (4, 6)


@pytest.mark.parametrize(
    "change",
    [
        {"width": 0},
        {"height": -3},
        {"fx": 0.0},
        {"fy": -5.0},
        {"fx": float("nan")},
        {"cx": float("inf")},
        {"width": 10**30},
        {"fx": 1e-300},
        {"fy": 1e19},
        {"fx": 1e300, "fy": 1e300},
        {"cx": 1e6},
    ],
)
def test_impossible_cameras_are_refused(change: dict[str, float]) -> None:
    values: dict[str, Any] = {"width": 12, "height": 8, "fx": 10.0, "fy": 11.0, "cx": 5.0, "cy": 4.0}
    with pytest.raises(DataError, match="camera: expected") as caught:
        Camera(**{**values, **change})
    assert len(str(caught.value)) < 300


def test_downscaling_to_nothing_is_refused() -> None:
    with pytest.raises(DataError, match="expected a size of 1 to"):
        CAMERA.downscaled(16)


def test_pixels_of_no_sensor_are_refused() -> None:
    with pytest.raises(DataError, match="fx and fy of one lens"):
        Camera(96, 64, 48.0, 1.5, 48.0, 32.0)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ((48.0, 48.0, 47.5, 31.5), []),
        ((48.0, 24.0, 47.5, 31.5), ["fx = 48 and fy = 24 mean pixels 2 times"]),
        ((48.0, 48.0, 1.5, 31.5), ["cx = 1.5 is far from the middle of 96"]),
        ((48.0, 48.0, 47.5, 60.0), ["cy = 60 is far from the middle of 64"]),
    ],
)
def test_values_of_no_usual_camera_are_said(
    values: tuple[float, float, float, float], words: list[str]
) -> None:
    lines = Camera(96, 64, *values).oddities
    assert len(lines) == len(words)
    assert all(word in line for word, line in zip(words, lines))
