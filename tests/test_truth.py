"""Where a true path is known: tried on real motion, with holes cut into it."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edslam_ti.trajectory import Trajectory, read_tum
from edslam_ti.truth import impossible_poses, true_path, true_poses_at


def hand_held(rate: float = 100.0, duration: float = 3.0) -> Trajectory:
    """Return a path of 0.3 m with accelerations of about 1 m/s^2."""
    t = np.arange(round(rate * duration) + 1) / rate
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    angles = np.stack([0.2 * np.sin(2 * t), 0.3 * np.cos(1.5 * t), 0.1 * t], -1)
    poses[:, :3, :3] = Rotation.from_rotvec(angles).as_matrix()
    poses[:, :3, 3] = np.stack([0.15 * np.sin(2.5 * t), 0.1 * np.cos(3 * t), 0.05 * t], -1)
    return Trajectory(t, poses)


def without(path: Trajectory, start: float, end: float) -> Trajectory:
    keep = (path.timestamps <= start) | (path.timestamps >= end)
    return Trajectory(path.timestamps[keep], path.poses[keep])


def test_pose_is_known_at_stamps_and_at_the_truths_own_rate() -> None:
    path = hand_held()
    times = np.array([-0.01, 0.0, 0.5, 0.503, 3.0, 3.0 + 5e-7, 3.01])
    poses, is_known = true_poses_at(path, times)
    assert is_known.tolist() == [False, True, True, True, True, True, False]
    assert np.isnan(poses[~is_known]).all()
    np.testing.assert_allclose(poses[3], path.at(0.503), atol=1e-12)


@pytest.mark.parametrize("length", [0.2, 0.4, 0.65, 2.0])
def test_no_pose_is_known_in_a_hole(length: float) -> None:
    path = without(hand_held(), 0.5, 0.5 + length)
    inside = np.linspace(0.53, 0.47 + length, 20)
    assert not true_poses_at(path, inside)[1].any()
    assert true_poses_at(path, np.array([0.5, 0.5 + length]))[1].all()


@pytest.mark.parametrize("rate", [10.0, 20.0, 30.0])
def test_one_missing_pose_of_a_slow_truth_is_a_hole(rate: float) -> None:
    path = hand_held(rate)
    missing = path.timestamps[10]
    keep = np.arange(len(path)) != 10
    holed = Trajectory(path.timestamps[keep], path.poses[keep])
    _, is_known = true_poses_at(holed, path.timestamps)
    assert is_known.tolist() == keep.tolist()
    off = holed.at(missing)[:3, 3] - path.pose(10)[:3, 3]
    assert np.linalg.norm(off) > 2e-4  # metres: it would have been an error of the truth


def test_one_missing_pose_of_motion_capture_is_no_hole() -> None:
    path = hand_held(120.0)
    keep = np.arange(len(path)) != 100
    assert true_poses_at(Trajectory(path.timestamps[keep], path.poses[keep]), path.timestamps)[1].all()


def test_truth_slower_than_half_a_second_is_known_at_its_stamps_only() -> None:
    path = hand_held()
    in_nanoseconds = Trajectory(1e9 * path.timestamps, path.poses)
    assert true_poses_at(in_nanoseconds, np.linspace(0, 3, 50))[1].sum() == 1


def test_hole_in_stamps_since_the_epoch_is_the_same_hole() -> None:
    path = without(hand_held(), 1.0, 1.65)
    late = Trajectory(path.timestamps + 1642650000.0, path.poses)
    times = np.arange(0, 3, 0.0137)
    expected = true_poses_at(path, times)[1]
    assert (~expected).sum() > 40
    np.testing.assert_array_equal(true_poses_at(late, times + 1642650000.0)[1], expected)


@pytest.mark.parametrize("name", ["corner_slow", "hdr_normal", "tum_vie_6dof", "tum_vie_desk2"])
@pytest.mark.parametrize("length", [0.05, 0.1, 0.2, 0.5, 1.0])
def test_what_is_counted_in_holes_of_real_motion_is_right(
    shared_data: Path, name: str, length: float
) -> None:
    file = shared_data / "trajectories" / f"{name}.txt"
    if not file.is_file():
        pytest.skip(f"{file} is not here")
    full = read_tum(file)
    random = np.random.default_rng(0)
    t, errors, ignored = full.timestamps, [0.0], []
    for start in random.uniform(t[0] + 3, t[-1] - 3 - length, 25):
        near = (t > start - 3) & (t < start + length + 3)
        hole = (t > start) & (t < start + length)
        holed = Trajectory(t[near & ~hole], full.poses[near & ~hole])
        is_known = true_poses_at(holed, t[hole])[1]
        off = holed.resampled(t[hole]).poses[:, :3, 3] - full.poses[hole][:, :3, 3]
        distances = 100 * np.linalg.norm(off, axis=1)
        errors += list(distances[is_known])
        ignored += list(distances[~is_known])
    # A tenth of an ATE of 0.1 cm is 0.01; where the camera shakes it is 0.014 of few poses.
    assert np.sqrt(np.mean(np.square(errors))) < 0.015
    assert max(errors) < 0.05
    if length >= 0.5:
        assert len(errors) < 0.01 * len(ignored)
        assert np.sqrt(np.mean(np.square(ignored))) > 0.1  # as large as what is to be measured


# --- poses that cannot be ---


@pytest.mark.parametrize("rate", [20.0, 120.0])
@pytest.mark.parametrize("distance", [0.3, 100.0, 1e200, np.inf])
def test_pose_that_jumps_away_is_left_out(rate: float, distance: float) -> None:
    path = hand_held(rate)
    poses = path.poses
    poses[20, 0, 3] += distance
    is_jump = impossible_poses(Trajectory(path.timestamps, poses))
    assert np.flatnonzero(is_jump).tolist() == [20]


@pytest.mark.parametrize("count", [7, 9, 15])
@pytest.mark.parametrize("distance", [1.0, 100.0])
def test_pose_that_jumps_away_from_a_short_path_is_left_out(count: int, distance: float) -> None:
    path = hand_held(20.0)
    poses = path.poses[:count].copy()
    poses[count // 2, 0, 3] += distance
    is_jump = impossible_poses(Trajectory(path.timestamps[:count], poses))
    assert np.flatnonzero(is_jump).tolist() == [count // 2]
    assert not impossible_poses(Trajectory(path.timestamps[:count], path.poses[:count])).any()


def test_several_poses_elsewhere_and_a_flipped_one_are_left_out() -> None:
    path = hand_held(120.0)
    poses = path.poses
    poses[100:110, 2, 3] += 0.4
    poses[200, :3, :3] = poses[200, :3, :3] @ np.diag([1.0, -1.0, -1.0])
    poses[-3:, 1, 3] -= 5
    poses[:2, 1, 3] -= 5
    truth = true_path(Trajectory(path.timestamps, poses))
    assert len(truth.jumps) == 10 + 1 + 3 + 2
    np.testing.assert_allclose(truth.jump_lengths[2:12], 0.4, atol=0.05)


def test_stamp_far_away_is_no_jump_and_no_truth() -> None:
    path = hand_held()
    far = Trajectory(np.append(path.timestamps, 1e200), np.concatenate([path.poses, path.poses[:1]]))
    _, is_known = true_poses_at(far, np.array([1.0, 3.0, 3.5, 1e199]))
    assert is_known.tolist() == [True, True, False, False]


def test_motion_is_no_jump() -> None:
    still = hand_held(100.0, 6.0)
    poses = still.poses
    moving = slice(300, 340)  # a camera at rest is pushed with 40 m/s^2, and rests again
    poses[:300] = poses[300]
    poses[moving, 0, 3] = poses[300, 0, 3] + 20 * (np.arange(40) / 100) ** 2
    poses[340:] = poses[339]
    assert not impossible_poses(Trajectory(still.timestamps, poses)).any()
    assert not impossible_poses(without(hand_held(), 1.0, 2.5)).any()
    noisy = hand_held().poses
    noisy[:, :3, 3] += np.random.default_rng(0).normal(0, 0.02, (len(noisy), 3))
    assert not impossible_poses(Trajectory(hand_held().timestamps, noisy)).any()


def test_real_motion_has_no_impossible_pose(shared_data: Path) -> None:
    files = sorted((shared_data / "trajectories").glob("*.txt"))
    if not files:
        pytest.skip("no recorded motion here")
    for file in files:
        assert not impossible_poses(read_tum(file)).any(), file.name


def test_all_poses_of_a_short_path_are_known() -> None:
    path = hand_held(20.0)
    assert not true_poses_at(Trajectory(), np.array([0.0]))[1].any()
    for count in (1, 2, 3):
        few = Trajectory(path.timestamps[:count], path.poses[:count])
        assert true_poses_at(few, few.timestamps)[1].all()
        assert not true_poses_at(few, np.array([1.0]))[1].any()
