"""The image at the beginning, from what events, depth and poses say about a textured wall."""

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.depth_images import block_means
from edslam_ti.event_images.solve import EventView, solve_start_image

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
DEPTH = 2.0  # metres, of a wall parallel to the image
ITERATIONS = {4: 100, 2: 100, 1: 30}
RANDOM = np.random.default_rng(0)


def wall(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return log brightness at points (metres) of the wall: a slope, a large disc and waves of 30 cm."""
    disc = np.where(np.hypot(x - 0.2, y) < 0.5, 0.6, 0.0)
    return 0.3 * x + disc + 0.2 * np.sin(2 * np.pi * x / 0.3) * np.cos(2 * np.pi * y / 0.3) - 1.0


def position(k: int) -> np.ndarray:  # [2] metres
    """Return where the camera is; a path along one line would leave stripes along it unknown."""
    return np.array([0.05 * k, 0.3 * np.sin(0.4 * k)])


def image_at(k: int) -> np.ndarray:  # [48, 64]
    points = DEPTH * CAMERA.rays()[..., :2] + position(k)
    return wall(points[..., 0], points[..., 1]).astype(np.float32)


def views(count: int = 14, noise: float = 0.0) -> list[EventView]:
    result = []
    for k in range(count):
        T = np.eye(4)
        T[:2, 3] = position(k)
        change = image_at(k) - image_at(0)
        if noise:
            change = change + RANDOM.uniform(-noise, noise, change.shape).astype(np.float32)
        result.append(EventView(change, np.full(CAMERA.shape, DEPTH, np.float32), T))
    return result


def error(start: np.ndarray, seen: np.ndarray) -> float:
    """Return the rms error in log brightness, up to a constant."""
    difference = (start - image_at(0))[seen]
    return float((difference - difference.mean()).std())


BLANK = np.full(CAMERA.shape, -0.7, np.float32)


def test_start_image_is_found_from_changes_alone() -> None:
    solved = solve_start_image(views(), CAMERA, BLANK, ITERATIONS)
    assert solved.is_observed.mean() > 0.9
    assert image_at(0).std() > 0.3
    assert error(solved.log_brightness, solved.is_observed) < 0.06  # half of it at the disc's edge


def test_noise_of_a_threshold_averages_out() -> None:
    solved = solve_start_image(views(noise=0.1), CAMERA, BLANK, ITERATIONS)
    assert error(solved.log_brightness, solved.is_observed) < 0.1
    smooth = block_means(solved.log_brightness - image_at(0), 8)
    assert smooth.std() < 0.04


def test_views_of_known_brightness_fix_the_level() -> None:
    relative = views()
    known = [
        EventView(image_at(k), v.depth, v.T_world_camera, is_relative=False)
        for k, v in enumerate(relative[:3])
    ]
    solved = solve_start_image(known + relative[3:], CAMERA, BLANK, ITERATIONS)
    difference = (solved.log_brightness - image_at(0))[solved.is_observed]
    assert abs(difference.mean()) < 0.03
    assert difference.std() < 0.08


def test_wrong_depth_of_one_view_counts_little() -> None:
    spoilt = views()
    assert spoilt[6].depth is not None
    spoilt[6].depth[:24] = 3.0
    spoilt[6].change[:] += RANDOM.normal(0, 1, CAMERA.shape).astype(np.float32)
    solved = solve_start_image(spoilt, CAMERA, BLANK, ITERATIONS)
    assert error(solved.log_brightness, solved.is_observed) < 0.12


@pytest.mark.parametrize("depth", [None, np.zeros(CAMERA.shape, np.float32)])
def test_without_depth_no_pixel_is_observed_and_the_start_is_kept(depth: np.ndarray | None) -> None:
    blind = [EventView(v.change, depth, v.T_world_camera) for v in views(4)]
    solved = solve_start_image(blind, CAMERA, BLANK, ITERATIONS)
    assert not solved.is_observed.any()
    np.testing.assert_array_equal(solved.log_brightness, BLANK)


def test_pixels_never_compared_follow_their_neighbours() -> None:
    with_hole = views()
    for v in with_hole:
        assert v.depth is not None
        v.depth[:, :8] = 0
    solved = solve_start_image(with_hole, CAMERA, BLANK + 5, ITERATIONS)
    assert not solved.is_observed[:, :3].any()
    inside = solved.log_brightness[:, :3].mean() - (BLANK.mean() + 5)
    beside = solved.log_brightness[:, 10:20].mean() - (BLANK.mean() + 5)
    assert abs(inside - beside) < 0.5 * abs(beside) + 0.3
