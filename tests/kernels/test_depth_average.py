"""Depth averaged over views, against its twin and a plane that is known."""

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.geometry import inverse, se3_exp
from edslam_ti.kernels import reference
from edslam_ti.kernels.depth_average import DepthAgreement, PixelRays, average_depth

CAMERA = Camera(41, 30, 36.0, 34.0, 20.0, 14.5)  # 41 x 30 pixels are no multiple of the lanes
AGREEMENT = DepthAgreement(0.003, 0.0019)
NORMAL, DISTANCE = np.array([0.1, -0.05, -1.0]), 2.0


def averaged(own: np.ndarray, others: list[np.ndarray], motions: list[np.ndarray]) -> np.ndarray:
    rays = PixelRays(CAMERA.shape, CAMERA.intrinsics)
    return average_depth(own, others, motions, rays, AGREEMENT)


def plane(T_world_camera: np.ndarray) -> np.ndarray:  # [H, W] metres
    """Return the depth of the plane n x + d = 0 of the world."""
    directions = CAMERA.rays() @ T_world_camera[:3, :3].T
    return (-(DISTANCE + NORMAL @ T_world_camera[:3, 3]) / (directions @ NORMAL)).astype(np.float32)


def poses(count: int, size: float = 0.03) -> list[np.ndarray]:
    return [se3_exp(twist) for twist in np.random.default_rng(3).normal(0, size, (count, 6))]


def test_average_is_that_of_the_twin() -> None:
    random = np.random.default_rng(0)
    depths = [(plane(np.eye(4)) + random.normal(0, 0.01, CAMERA.shape)).astype(np.float32) for _ in range(5)]
    for depth in depths:
        depth[random.random(CAMERA.shape) < 0.02] = 0
    own, others, motions = depths[0], depths[1:], poses(4)
    average = averaged(own, others, motions)
    expected = reference.average_depth(own, others, motions, CAMERA.intrinsics, AGREEMENT)
    assert 0.001 < np.abs(expected - own).mean() < 0.02
    # Single precision may put a measurement on the other side of the gate, or a point of the border.
    assert (np.abs(average - expected) > 1e-4).mean() < 0.005
    assert (average[own == 0] == 0).all()


def test_noise_averages_out() -> None:
    random, T_world_camera = np.random.default_rng(1), poses(6)
    truth = [plane(T) for T in T_world_camera]
    noisy = [d + random.normal(0, 0.008, d.shape).astype(np.float32) for d in truth]
    motions = [inverse(T) @ T_world_camera[0] for T in T_world_camera[1:]]
    average = averaged(noisy[0], noisy[1:], motions)
    inner = np.s_[6:-6, 6:-6]
    before, after = (np.std((d - truth[0])[inner]) for d in (noisy[0], average))
    assert after < 0.55 * before  # 0.41, were all views seen at their own pixels


def test_another_surface_does_not_count() -> None:
    own = np.full(CAMERA.shape, 1.5, np.float32)
    nearer, missing = np.full(CAMERA.shape, 1.2, np.float32), np.zeros(CAMERA.shape, np.float32)
    average = averaged(own, [nearer, missing], [np.eye(4)] * 2)
    np.testing.assert_allclose(average, own)
    np.testing.assert_array_equal(averaged(own, [], []), own)


def test_images_of_another_size_are_refused() -> None:
    own = np.full(CAMERA.shape, 1.5, np.float32)
    with pytest.raises(ValueError, match="others: expected shape"):
        averaged(own, [own[1:]], [np.eye(4)])
