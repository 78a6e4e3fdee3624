"""The keyframe's brightness image: the kernels against their twins, and a scene that is known."""

from collections.abc import Sequence

import numpy as np
import pytest

from edslam_ti import kernels
from edslam_ti.camera import Camera
from edslam_ti.event_images.solve import HUBER, Observation, solve_log_brightness_image
from edslam_ti.geometry import se3_exp
from edslam_ti.kernels import reference
from edslam_ti.kernels.brightness_image import ChangeImage, Pair, solve_brightness_image

CAMERA = Camera(41, 30, 36.0, 36.0, 20.0, 14.5)  # 41 x 30 pixels are no multiple of the lanes
PRIOR_WEIGHT = 1e-2
RANDOM = np.random.default_rng(0)


def scene() -> np.ndarray:  # [h, w] metres
    """Return the depth of a slanted wall with a box before it and a hole."""
    depth = np.tile(np.linspace(1.8, 2.4, CAMERA.width, dtype=np.float32), (CAMERA.height, 1))
    depth[8:20, 15:25] = 1.2
    depth[22:25, 3:8] = 0
    return depth


def observations(count: int = 5) -> list[Observation]:
    """Return random changes, so that every equation counts; every second time without depth."""
    twists = RANDOM.normal(0, 0.04, (count, 6))
    changes = RANDOM.normal(0, 0.3, (count, *CAMERA.shape)).astype(np.float32)
    return [
        Observation(se3_exp(twist), change, None if k % 2 else scene())
        for k, (twist, change) in enumerate(zip(twists, changes))
    ]


def minimum(
    systems: list[tuple[np.ndarray, np.ndarray]], prior: np.ndarray, is_robust: Sequence[bool]
) -> np.ndarray:
    A, b = (np.concatenate(parts) for parts in zip(*systems, strict=True))
    return reference.brightness_image(A, b, prior, PRIOR_WEIGHT, HUBER, is_robust)


def solved(prior: np.ndarray, seen: list[Observation], iterations: int, is_robust: bool) -> np.ndarray:
    return solve_log_brightness_image(scene(), CAMERA, seen, prior, PRIOR_WEIGHT, iterations, is_robust)


@pytest.mark.slow
@pytest.mark.parametrize("is_robust", [False, True])
def test_image_is_that_of_the_twin(is_robust: bool) -> None:
    prior = RANDOM.normal(0, 0.3, CAMERA.shape).astype(np.float32)
    seen = observations()
    own = ChangeImage(np.zeros(CAMERA.shape, np.float32), scene())
    systems = [
        reference.brightness_equations(
            own, ChangeImage(o.change, o.depth), o.T_camera_keyframe, CAMERA.intrinsics
        )
        for o in seen
    ]
    expected = minimum(systems, prior, [is_robust])
    assert np.abs(expected - prior).max() > 0.3
    np.testing.assert_allclose(solved(prior, seen, 200, is_robust), expected, atol=1e-3)  # single precision


@pytest.mark.slow
def test_equations_of_any_two_images_with_known_ones_among_them() -> None:
    """The image is solved twice, the second time robustly; hidden and unmeasured surfaces are left out."""
    prior = RANDOM.normal(0, 0.3, CAMERA.shape).astype(np.float32)
    changes = RANDOM.normal(0, 0.3, (4, *CAMERA.shape)).astype(np.float32)
    measured = scene()
    measured[:, :12] = 0  # nothing is known of what is at the left
    depths = [measured, measured, None, measured]
    images = [ChangeImage(change, depth, k == 1) for k, (change, depth) in enumerate(zip(changes, depths))]
    chosen = [(0, 1), (1, 0), (0, 2), (2, 0), (3, 1), (0, 3)]
    pairs = [Pair(*two, se3_exp(RANDOM.normal(0, 0.04, 6))) for two in chosen]
    robust = (False, True)
    systems = [
        reference.brightness_equations(
            images[p.first], images[p.second], p.T_second_first, CAMERA.intrinsics, is_strict=True
        )
        for p in pairs
        if p.first != 2  # it has no depth
    ]
    expected = minimum(systems, prior, robust)
    level, is_observed = solve_brightness_image(
        images, pairs, CAMERA.intrinsics, prior, PRIOR_WEIGHT, HUBER, 300, robust, is_strict=True
    )
    np.testing.assert_allclose(level, expected, atol=1e-3)
    in_equations = sum(np.abs(A).sum(0) for A, _ in systems).reshape(CAMERA.shape) > 0
    assert 0.5 < in_equations.mean() < 1
    assert (is_observed != in_equations).mean() < 0.01  # bilinear weights near zero
    np.testing.assert_array_equal(level[~is_observed], prior[~is_observed])


@pytest.mark.slow
def test_image_is_the_same_for_any_number_of_threads(device: str) -> None:
    prior, seen = RANDOM.normal(0, 0.3, CAMERA.shape).astype(np.float32), observations()
    images = []
    for threads in (1, 2, 2):  # 2 is what the other tests run with
        kernels.init(device, threads=threads)
        images.append(solved(prior, seen, 12, True))
        solved(-prior, observations(), 12, True)  # leaves nothing behind
    assert np.array_equal(images[0], images[1])
    assert np.array_equal(images[1], images[2])


def test_unobserved_pixels_keep_their_prior() -> None:
    prior = RANDOM.normal(0, 0.3, CAMERA.shape).astype(np.float32)
    np.testing.assert_array_equal(solved(prior, [], 12, True), prior)
    away = np.eye(4)
    away[2, 3] = -10.0  # everything is behind the camera
    change = np.ones(CAMERA.shape, np.float32)
    np.testing.assert_array_equal(solved(prior, [Observation(away, change, None)], 12, True), prior)


def test_changes_of_a_known_image_give_it_back() -> None:
    """Shifted views of a wall: the image follows up to the level, which no change tells."""
    depth = np.full(CAMERA.shape, 2.0, np.float32)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]

    def image(dx: float, dy: float) -> np.ndarray:
        return 0.4 * np.sin((u + dx) / 3.0) * np.cos((v + dy) / 4.0)

    seen = []
    for dx, dy in ((1, 0), (0, 1), (3, 1), (-2, 2), (-1, -3), (2, -2)):
        T = np.eye(4)
        T[:2, 3] = -dx * 2.0 / CAMERA.fx, -dy * 2.0 / CAMERA.fy
        seen.append(Observation(T, (image(dx, dy) - image(0, 0)).astype(np.float32), depth))
    level = solve_log_brightness_image(
        depth, CAMERA, seen, np.zeros(CAMERA.shape, np.float32), 1e-3, iterations=100
    )
    error = (level - image(0, 0))[4:-4, 4:-4]
    assert error.std() < 0.02  # of 0.2


def test_images_of_another_size_are_refused() -> None:
    seen = [Observation(np.eye(4), np.zeros(CAMERA.shape, np.float32), None)]
    with pytest.raises(ValueError, match="prior: expected shape"):
        solve_log_brightness_image(scene(), CAMERA, seen, np.zeros((3, 4), np.float32))
