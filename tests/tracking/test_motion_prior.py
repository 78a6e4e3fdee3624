"""The motion prior against a general minimiser, and on paths that are known."""

import numpy as np
from scipy.optimize import least_squares

from edslam_ti.geometry import inverse, se3_exp, se3_log
from edslam_ti.tracking.motion_prior import MeasuredPose, MotionPrior

TIMES = np.array([0.0, 0.05, 0.1, 0.14, 0.2, 0.25, 0.3])
VELOCITY = np.array([0.4, -0.1, 0.2, 0.3, 0.5, -0.2])  # metres and radians per second


def path() -> list[np.ndarray]:  # N times [4, 4]
    """Return poses along a screw: constant velocity of the body."""
    return [se3_exp(t * VELOCITY) for t in TIMES]


def informed(sigma: float = 0.002) -> MotionPrior:
    prior = MotionPrior()
    random = np.random.default_rng(0)
    bent = [T @ se3_exp(random.normal(0, 2e-4, 6)) for T in path()]
    prior.learn_motion(TIMES, bent)
    prior.learn_error(np.full(6, sigma), np.eye(6) / sigma**2)
    return prior


def measured(noise: float) -> list[MeasuredPose]:
    """Return poses of which the first, the second and the last are exact."""
    random = np.random.default_rng(1)
    result = []
    for k, (t, T) in enumerate(zip(TIMES, path())):
        if k in (0, 1, len(TIMES) - 1):
            result.append(MeasuredPose(k, t, T, None))
        else:
            noisy = T @ se3_exp(random.normal(0, noise, 6))
            result.append(MeasuredPose(k, t, noisy, np.eye(6) / noise**2))
    return result


def test_noise_shrinks_and_exact_poses_stay() -> None:
    poses = measured(0.002)
    after = informed().smoothed(poses)
    for k in (0, 1, len(TIMES) - 1):
        assert np.array_equal(after[k], poses[k].T_world_camera)

    def rms(candidates: list[np.ndarray]) -> float:
        errors = [se3_log(inverse(T) @ c) for T, c in zip(path(), candidates)]
        return float(np.sqrt(np.mean(np.square(errors))))

    assert rms(after) < 0.5 * rms([m.T_world_camera for m in poses])


def test_smoothed_poses_are_the_minimum_of_the_cost() -> None:
    prior, poses = informed(), measured(0.002)
    q = np.mean(prior._accelerations, 0)
    free = [k for k, m in enumerate(poses) if m.information is not None]

    def residuals(unknown: np.ndarray) -> np.ndarray:
        T = [m.T_world_camera for m in poses]
        for k, twist in zip(free, unknown.reshape(-1, 6)):
            T[k] = T[k] @ se3_exp(twist)
        d = np.diff(TIMES)
        v = np.array([se3_log(inverse(T[k]) @ T[k + 1]) / d[k] for k in range(len(d))])
        change = np.diff(v, axis=0) / np.sqrt(q * (d[:-1] + d[1:])[:, None] / 2)
        return np.concatenate([unknown / 0.002, change.ravel()])

    best = least_squares(residuals, np.zeros(6 * len(free)), xtol=1e-14, ftol=1e-14).x.reshape(-1, 6)
    assert np.abs(best).max() > 1e-3
    for k, twist, T in zip(free, best, [prior.smoothed(poses)[k] for k in free]):
        np.testing.assert_allclose(
            T, poses[k].T_world_camera @ se3_exp(twist), atol=1e-4
        )  # of 4e-3: one step


def test_quickness_of_the_motion_is_learned() -> None:
    """A random walk of the velocity in small steps; seen every 0.2 s."""
    random, q, step = np.random.default_rng(2), np.repeat([0.5, 0.1], 3), 0.005
    velocity, T, poses = np.zeros(6), np.eye(4), [np.eye(4)]
    for k in range(40 * 60):
        velocity = velocity + random.normal(0, np.sqrt(q * step))
        T = T @ se3_exp(step * velocity)
        if k % 40 == 39:
            poses.append(T)
    means = []
    for start in range(0, 60, 15):  # the newest twenty observations count
        prior = MotionPrior()
        prior.learn_motion(0.2 * np.arange(16), poses[start : start + 16])
        means.append(np.mean(prior._accelerations, 0))
    np.testing.assert_allclose(np.mean(means, 0), q, rtol=0.3)


def test_errors_are_compared_with_their_prediction() -> None:
    prior = MotionPrior()
    assert not prior.is_known
    random, sigma = np.random.default_rng(3), 0.003
    for _ in range(20):
        prior.learn_error(random.normal(0, 3 * sigma, 6), np.eye(6) / sigma**2)
    assert 7 < prior.error < 11
    prior.learn_motion(TIMES, path())
    assert prior.is_known
