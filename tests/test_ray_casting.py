"""Rays at triangles whose distances are known."""

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.ray_casting import RayCaster, pixel_rays, rays_from

CAMERA = Camera(width=12, height=8, fx=10.0, fy=11.0, cx=5.25, cy=3.75)
CORNERS = np.array([[-9.0, -9, 2], [9, -9, 2], [9, 9, 2], [-9, 9, 2]])  # of a wall across z, 2 m away
WALL = RayCaster(CORNERS, np.array([[0, 1, 2], [0, 2, 3]]))


def test_distance_of_a_pixels_ray_is_its_depth() -> None:
    back = np.eye(4)
    back[2, 3] = -0.5
    hits = WALL.cast(pixel_rays(CAMERA, back))
    assert hits.depth.shape == CAMERA.shape
    np.testing.assert_allclose(hits.depth, 2.5, rtol=1e-6)
    np.testing.assert_allclose(np.abs(hits.normal[..., 2]), 1, rtol=1e-6)


def test_weights_of_the_corners_give_the_point_that_was_hit() -> None:
    rays = pixel_rays(CAMERA, np.eye(4))
    hits = WALL.cast(rays)
    u, v = hits.uv[..., :1], hits.uv[..., 1:]
    corners = CORNERS[np.array([[0, 1, 2], [0, 2, 3]])[hits.triangle]]  # [H, W, 3, 3]
    points = (1 - u - v) * corners[..., 0, :] + u * corners[..., 1, :] + v * corners[..., 2, :]
    np.testing.assert_allclose(points, 2 * CAMERA.rays(), atol=1e-5)


def test_rays_that_hit_nothing_have_no_depth() -> None:
    away = np.diag([1.0, -1, -1, 1])  # turned round
    hits = WALL.cast(pixel_rays(CAMERA, away))
    assert not np.isfinite(hits.distance).any()
    assert not hits.depth.any()
    nothing = RayCaster(np.empty((0, 3)), np.empty((0, 3), int))
    assert not nothing.cast(pixel_rays(CAMERA, np.eye(4))).depth.any()


def test_a_ray_is_blocked_between_its_ends_only() -> None:
    rays = rays_from(np.eye(4), np.array([[0.0, 0, 4], [0, 0, 1], [0, 0, -4]]))
    assert WALL.is_blocked(rays, near=0.0, far=1.0).tolist() == [True, False, False]
    assert WALL.is_blocked(rays, near=0.6, far=3.0).tolist() == [False, True, False]


def test_distance_to_the_nearest_triangle_is_never_negative() -> None:
    points = np.array([[0, 0, 1.5], [1, 1, 2.25], [12, 0, 2]], np.float32)
    assert WALL.distances_to(points) == pytest.approx([0.5, 0.25, 3.0], abs=1e-6)
