"""The pose graph: what drift a revisit takes back, and how frames between keyframes follow."""

import itertools

import numpy as np

from edslam_ti.geometry import inverse, se3_exp, se3_log
from edslam_ti.tracking.pose_graph import Revisit, corrections, spread


def circle(count: int) -> list[np.ndarray]:
    """Return poses once around a circle of 2 m, looking outwards, the last one where the first is."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, count):
        T = se3_exp(np.array([0, 0, 0, 0, 0, angle]))
        T[:3, 3] = 2 * np.cos(angle), 2 * np.sin(angle), 0
        poses.append(T)
    return poses


def drifted(poses: list[np.ndarray], seed: int) -> list[np.ndarray]:
    """Return the poses with a bias and noise in every motion from one to the next."""
    random = np.random.default_rng(seed)
    bias = np.array([1e-3, 5e-4, -5e-4, 2e-4, 0, 5e-4])
    result = poses[:1]
    for a, b in itertools.pairwise(poses):
        error = bias + 5e-4 * random.standard_normal(6)
        result.append(result[-1] @ inverse(a) @ b @ se3_exp(error))
    return result


def rmse(poses: list[np.ndarray], truth: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean([np.sum((a - b)[:3, 3] ** 2) for a, b in zip(poses, truth)])))


def test_closing_a_loop_removes_most_of_the_drift() -> None:
    truth = circle(61)
    before = drifted(truth, seed=0)
    loop = [Revisit(10 * k, 10 * (60 - 2 + k), inverse(truth[k]) @ truth[58 + k]) for k in (0, 1, 2)]
    moved = corrections([10 * k for k in range(61)], before, loop)
    after = [c @ T for c, T in zip(moved, before)]
    np.testing.assert_allclose(after[0], before[0], atol=1e-9)  # the first stays
    end = se3_log(inverse(truth[60]) @ after[60])
    assert np.abs(end).max() < 3e-3 < np.abs(se3_log(inverse(truth[60]) @ before[60])).max()
    assert rmse(after, truth) < 0.4 * rmse(before, truth)


def test_poses_that_agree_stay_where_they_are() -> None:
    poses = circle(13)
    moved = corrections(list(range(13)), poses, [Revisit(0, 12, inverse(poses[0]) @ poses[12])])
    np.testing.assert_allclose(moved, np.tile(np.eye(4), (13, 1, 1)), atol=1e-6)


def test_frames_between_keyframes_follow_in_part() -> None:
    first, last = se3_exp(np.zeros(6)), se3_exp(np.array([0.04, 0, 0, 0, 0.02, 0]))
    for frame, share in ((0, 0.0), (10, 0.0), (15, 0.25), (30, 1.0), (99, 1.0)):
        twist = se3_log(spread(frame, [10, 30], [first, last]))
        np.testing.assert_allclose(twist, share * se3_log(last), atol=1e-12)
