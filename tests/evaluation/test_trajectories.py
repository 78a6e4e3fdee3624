"""Errors of trajectories: agreement with evo, and paths that leave the alignment free."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edslam_ti.errors import DataError
from edslam_ti.evaluation.trajectories import (
    align_views,
    ate_rmse_cm,
    inceventgs_slice,
    statistics,
    trajectory_errors,
)
from edslam_ti.trajectory import Trajectory


def helix(count: int = 60) -> Trajectory:
    t = np.linspace(0, 3, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.stack([0.1 * t, np.sin(t), 0 * t], -1)).as_matrix()
    poses[:, :3, 3] = np.stack([np.cos(2 * t), np.sin(2 * t), 0.3 * t], -1)
    return Trajectory(t, poses)


def moved(path: Trajectory, T: np.ndarray, scale: float = 1.0, noise: float = 0.0) -> Trajectory:
    poses = path.poses
    poses[:, :3, 3] = scale * poses[:, :3, 3] + np.random.default_rng(0).normal(
        0, noise or 1e-12, (len(path), 3)
    )
    return Trajectory(path.timestamps, T @ poses)


SOME_MOTION = np.eye(4)
SOME_MOTION[:3, :3] = Rotation.from_rotvec([0.5, -1.0, 2.0]).as_matrix()
SOME_MOTION[:3, 3] = [1.0, 2.0, 3.0]


def test_a_rigid_motion_of_the_whole_path_is_no_error() -> None:
    errors = trajectory_errors(moved(helix(), SOME_MOTION), helix())
    assert errors.num_poses == 60
    for value in (errors.ate_rmse_cm, errors.ate_max_cm, errors.ate_rmse_sim3_cm, errors.rpe_trans_cm):
        assert value < 1e-6
    assert errors.rpe_rot_deg < 1e-4  # arc cosine near 1


def test_scale_is_an_error_under_se3_and_none_under_sim3() -> None:
    errors = trajectory_errors(moved(helix(), SOME_MOTION, scale=1.1), helix())
    assert errors.ate_rmse_cm > 5
    assert errors.ate_rmse_sim3_cm < 1e-6
    assert errors.scale == pytest.approx(1 / 1.1)


def test_errors_are_those_of_evo() -> None:
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    estimate, truth = moved(helix(), SOME_MOTION, noise=0.02), helix()
    ours = trajectory_errors(estimate, truth)
    reference = PoseTrajectory3D(poses_se3=list(truth.poses), timestamps=truth.timestamps)
    for with_scale, errors in ((False, ours.errors_cm), (True, ours.errors_sim3_cm)):
        aligned = PoseTrajectory3D(poses_se3=list(estimate.poses), timestamps=truth.timestamps)
        aligned.align(reference, correct_scale=with_scale)
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data((reference, aligned))
        for name, value in ape.get_all_statistics().items():
            expected = value * (1e4 if name == "sse" else 100)
            assert statistics(errors)[name] == pytest.approx(expected, rel=1e-6)


def test_the_ate_alone_is_the_same() -> None:
    truth = helix(300)
    times = np.linspace(0.5, 2.5, 41) + 0.0003
    estimate = moved(truth.resampled(times), SOME_MOTION, scale=1.05, noise=0.01)
    errors = trajectory_errors(estimate, truth)
    assert ate_rmse_cm(estimate, truth) == pytest.approx(errors.ate_rmse_cm)
    assert ate_rmse_cm(estimate, truth, with_scale=True) == pytest.approx(errors.ate_rmse_sim3_cm)
    assert ate_rmse_cm(Trajectory(times[:2], truth.poses[:2]), truth) is None


def test_truth_is_interpolated_at_the_estimates_times() -> None:
    dense = helix(3000)
    times = np.linspace(0.5, 2.5, 41) + 0.0003
    errors = trajectory_errors(moved(dense.resampled(times), SOME_MOTION), dense)
    assert errors.num_poses == 41
    assert errors.ate_max_cm < 1e-4


def test_poses_outside_the_truth_or_in_its_gaps_are_left_out() -> None:
    full = helix(301)  # 10 ms
    t = full.timestamps
    keep = (t >= 1.0) & ~((t > 1.5) & (t < 2.2))
    truth = Trajectory(t[keep], full.poses[keep])
    errors = trajectory_errors(full, truth)
    assert errors.timestamps == pytest.approx(t[keep])
    assert errors.ate_max_cm < 1e-6


def test_a_straight_path_has_errors_too() -> None:
    count = 50
    t = np.linspace(0, 1, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = t
    truth = Trajectory(t, poses)
    noisy = poses.copy()
    noisy[:, 1, 3] += 0.01 * np.where(np.arange(count) % 2, 1, -1)
    errors = trajectory_errors(Trajectory(t, SOME_MOTION @ noisy), truth)
    assert errors.ate_rmse_cm == pytest.approx(1.0, rel=0.01)
    # The rotation about the line is taken from the orientations: y of the truth stays y.
    assert errors.aligned_positions == pytest.approx(noisy[:, :3, 3], abs=1e-3)


def test_a_stationary_path_also_has_errors() -> None:
    still = Trajectory(np.arange(5.0), np.tile(np.eye(4), (5, 1, 1)))
    errors = trajectory_errors(still, moved(still, SOME_MOTION))
    assert errors.ate_max_cm < 1e-6
    assert errors.scale == 1.0
    path = helix()
    standing = Trajectory(path.timestamps, np.tile(np.eye(4), (60, 1, 1)))
    assert trajectory_errors(standing, path).ate_rmse_cm > 50


def test_fewer_than_three_common_poses_are_refused() -> None:
    later = Trajectory(helix().timestamps + 2.95, helix().poses)
    with pytest.raises(DataError, match=r"expected at least 3 poses .* got 1 of 60"):
        trajectory_errors(later, helix())


def test_views_of_a_short_noisy_path_are_aligned_by_their_orientations() -> None:
    random = np.random.default_rng(0)
    truth = helix(40).poses
    truth[:, :3, 3] *= 0.01  # a path of centimetres
    estimated = np.linalg.inv(SOME_MOTION) @ truth
    assert align_views(estimated, truth) == pytest.approx(SOME_MOTION, abs=1e-9)
    estimated[:, :3, 3] += random.normal(0, 1e-3, (40, 3))  # 1 mm
    from_positions = trajectory_errors(
        Trajectory(helix(40).timestamps, estimated), Trajectory(helix(40).timestamps, truth)
    ).T_truth_estimate

    def turned(T: np.ndarray) -> float:
        return float(np.degrees(Rotation.from_matrix((T @ np.linalg.inv(SOME_MOTION))[:3, :3]).magnitude()))

    assert turned(align_views(estimated, truth)) < 0.02
    assert turned(from_positions) > 0.2


def test_slice_of_inceventgs_counts_every_second_pose() -> None:
    t = 0.1 + 0.05 * np.arange(200)
    truth = Trajectory(t, np.tile(np.eye(4), (200, 1, 1)))
    slice_s = inceventgs_slice("office0", truth, truth)  # 10:60 of every second pose
    assert slice_s == pytest.approx((1.1, 6.1))
    assert inceventgs_slice("office0", truth, Trajectory(t[40:], truth.poses[40:])) is None
    assert inceventgs_slice("office3", truth, truth) is None  # 200 to 300: later than this path
    assert inceventgs_slice("kitchen", truth, truth) is None
