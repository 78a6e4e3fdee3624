"""Where Gaussians are added (Eq. 13), at what spacing, as what discs."""

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.mapping.insertion import densify_mask, depth_to_points, spaced, surface_discs

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


def test_discs_lie_on_a_tilted_plane_and_look_round_from_the_camera() -> None:
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    normal = np.array([0.6, 0.0, -0.8])
    depth = (-2.0 / (camera.rays() @ normal)).astype(np.float32)  # the plane 2 m away along its normal
    T = pose()
    pixels = np.array([[31, 23], [10, 40], [50, 5]])
    quats, elongation = surface_discs(depth, camera, T, pixels, max_elongation=10.0)
    for (x, y), (qw, qx, qy, qz), longer in zip(pixels, quats.astype(np.float64), elongation):
        v, w = np.array([qx, qy, qz]), qw
        axes = np.stack([e + 2 * np.cross(v, np.cross(v, e) + w * e) for e in np.eye(3)], -1)
        np.testing.assert_allclose(np.abs(axes[:, 2] @ T[:3, :3] @ normal), 1.0, atol=1e-4)
        ray = camera.rays()[y, x] / np.linalg.norm(camera.rays()[y, x])
        across, along = (T[:3, :3].T @ axes[:, k] for k in (0, 1))
        seen = [np.linalg.norm(a - (a @ ray) * ray) for a in (across, longer * along)]
        np.testing.assert_allclose(seen, 1.0, atol=1e-3)  # a circle, seen along the ray


def test_disc_next_to_missing_depth_or_an_edge_faces_the_camera() -> None:
    camera = Camera(20, 10, 20.0, 20.0, 9.5, 4.5)
    depth = np.full(camera.shape, 2.0, np.float32)
    depth[:, 10:] = 3.0
    depth[5, 5] = 0
    pixels = np.array([[9, 4], [4, 5], [0, 0]])
    _, elongation = surface_discs(depth, camera, np.eye(4), pixels, max_elongation=4.0)
    np.testing.assert_allclose(elongation, 1.0)
    _, elongation = surface_discs(depth, camera, np.eye(4), np.array([[2, 2]]), max_elongation=4.0)
    assert elongation[0] > 1  # seen from the side


def test_densify_mask_is_the_truth_table_of_eq_13() -> None:
    depth = np.array([[2.0, 2.0, 2.0, 0.0, 2.0, 2.0]])
    alpha = np.array([[0.9, 0.7, 0.9, 0.1, 0.9, 0.9]])
    rendered = np.array([[2.01, 2.0, 3.0, 0.0, 2.01, 2.01]])
    mask = densify_mask(alpha, rendered, depth, min_visibility=0.8, depth_error_factor=50.0)
    # well seen | transparent | 100 times the median error | nothing measured | well seen ...
    assert mask.tolist() == [[False, True, True, False, False, False]]


def test_empty_map_needs_gaussians_wherever_there_is_depth() -> None:
    depth = np.array([[1.0, 0.0], [2.0, 3.0]])
    nothing = np.zeros_like(depth)
    assert (densify_mask(nothing, nothing, depth, 0.8, 50.0) == (depth > 0)).all()
    assert not densify_mask(nothing, nothing, nothing, 0.8, 50.0).any()


def test_one_pixel_is_chosen_per_block_of_the_spacing() -> None:
    spacing = np.full((6, 9), 3)
    spacing[:, 3:] = 1
    expected = np.ones((6, 9), bool)
    expected[:, :3] = False
    expected[[1, 4], 1] = True
    assert (spaced(spacing) == expected).all()
