"""Paths over time: interpolation, prediction, and the TUM format."""

from pathlib import Path

import numpy as np
import pytest
import torch

from edslam_ti.errors import DataError
from edslam_ti.geometry import se3_exp
from edslam_ti.trajectory import Trajectory, read_tum, write_tum

TWIST = torch.tensor([0.1, -0.05, 0.2, 0.3, -0.1, 0.05], dtype=torch.float64)


def constant_velocity(times: np.ndarray) -> Trajectory:
    return Trajectory(times, se3_exp(torch.from_numpy(times)[:, None] * TWIST).numpy())


def test_path_is_interpolated_inside_and_extended_outside() -> None:
    path = constant_velocity(np.array([1.0, 1.5, 2.5]))
    for t in (1.0, 1.2, 1.5, 2.1, 2.5, 0.5, 3.0):
        np.testing.assert_allclose(path.at(t), se3_exp(t * TWIST).numpy(), atol=1e-12)


def test_single_pose_is_kept() -> None:
    path = constant_velocity(np.array([1.0]))
    np.testing.assert_array_equal(path.at(7.0), path.pose(0))


def test_empty_path_has_no_pose() -> None:
    assert len(Trajectory()) == 0
    assert Trajectory().poses.shape == (0, 4, 4)
    assert not Trajectory().covers(0.0)
    with pytest.raises(DataError, match="no pose"):
        Trajectory().at(0.0)


def test_covers_only_its_time_range() -> None:
    path = constant_velocity(np.array([1.0, 2.0]))
    assert path.covers(1.0)
    assert path.covers(1.5)
    assert path.covers(2.0)
    assert not path.covers(0.99)
    assert not path.covers(2.01)


def test_appended_poses_are_copies() -> None:
    pose, path = np.eye(4), Trajectory()
    path.append(0.0, pose)
    pose[0, 3] = 5.0
    assert path.at(0.0)[0, 3] == 0
    path.at(0.0)[0, 3] = 5.0
    assert path.at(0.0)[0, 3] == 0


def test_replaced_pose_is_the_new_one() -> None:
    path = constant_velocity(np.array([0.0, 1.0]))
    path.replace(1, np.eye(4))
    np.testing.assert_array_equal(path.at(1.0), np.eye(4))


def test_times_must_increase() -> None:
    with pytest.raises(DataError, match="strictly increasing"):
        Trajectory(np.array([0.0, 0.0]), np.tile(np.eye(4), (2, 1, 1)))
    path = constant_velocity(np.array([0.0, 1.0]))
    with pytest.raises(DataError, match="not later"):
        path.append(1.0, np.eye(4))
    with pytest.raises(DataError, match="one pose per time stamp"):
        Trajectory(np.array([0.0]), np.tile(np.eye(4), (2, 1, 1)))


def test_resampled_path_is_the_same_path() -> None:
    path = constant_velocity(np.array([0.0, 1.0, 2.0]))
    resampled = path.resampled(np.array([0.5, 1.0, 1.75]))
    np.testing.assert_allclose(resampled.at(1.3), path.at(1.3), atol=1e-12)


def test_length_is_the_way_along_the_poses() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 0, 3], poses[2, :2, 3] = 3.0, [3.0, 4.0]
    assert Trajectory(np.arange(3.0), poses).length() == pytest.approx(7.0)
    assert Trajectory().length() == 0


def test_tum_file_reads_back_the_path(tmp_path: Path) -> None:
    path = constant_velocity(np.linspace(0, 5, 20))
    write_tum(path, tmp_path / "trajectory_tum.txt")
    back = read_tum(tmp_path / "trajectory_tum.txt")
    np.testing.assert_allclose(back.timestamps, path.timestamps, atol=1e-9)
    np.testing.assert_allclose(back.poses, path.poses, atol=2e-9)  # nine decimals


def test_tum_file_is_what_evo_reads(tmp_path: Path) -> None:
    from evo.tools.file_interface import read_tum_trajectory_file

    path = constant_velocity(np.linspace(0, 5, 20))
    write_tum(path, tmp_path / "trajectory_tum.txt")
    poses = read_tum_trajectory_file(str(tmp_path / "trajectory_tum.txt")).poses_se3
    np.testing.assert_allclose(poses, path.poses, atol=1e-8)


def test_tum_line_is_time_position_and_quaternion_with_w_last(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    write_tum(Trajectory(np.array([0.25]), pose[None]), tmp_path / "t.txt")
    line = (tmp_path / "t.txt").read_text().splitlines()[1]
    assert [float(v) for v in line.split()] == [0.25, 1, 2, 3, 0, 0, 0, 1]


def test_comments_and_repeated_times_are_passed_over_and_rows_are_sorted(tmp_path: Path) -> None:
    file = tmp_path / "t.txt"
    file.write_text(
        "# t x y z\n0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n1 9 0 0 0 0 0 1\n0.5 9 0 0 0 0 0 1\n2 2 0 0 0 0 0 1\n"
    )
    path = read_tum(file)
    assert path.timestamps.tolist() == [0, 0.5, 1, 2]
    assert path.poses[:, 0, 3].tolist() == [0, 9, 1, 2]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "8 numbers a line"),
        ("# nothing\n", "8 numbers a line"),
        ("0 1 2 3\n", "8 numbers a line"),
        ("a b c d e f g h\n", "expected lines"),
        ("0 0 0 0 0 0 0 1\n1 0 0\n", "expected lines"),
        ("0 nan 0 0 0 0 0 1\n", "not finite"),
        ("0 0 0 0 0 0 0 0\n", "quaternion is zero"),
    ],
)
def test_broken_tum_files_are_refused_in_one_line(tmp_path: Path, content: str, message: str) -> None:
    file = tmp_path / "t.txt"
    file.write_text(content)
    with pytest.raises(DataError, match=message):
        read_tum(file)


def test_absent_and_binary_tum_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="absent"):
        read_tum(tmp_path / "absent.txt")
    (tmp_path / "binary.txt").write_bytes(bytes(range(128, 256)))
    with pytest.raises(DataError, match=r"binary\.txt"):
        read_tum(tmp_path / "binary.txt")


def test_spread_poses_are_apart_in_place_or_direction() -> None:
    poses = np.tile(np.eye(4), (31, 1, 1))
    poses[:11, 0, 3] = 0.03 * np.arange(11)  # 30 cm along x,
    poses[11:, 0, 3] = 0.3
    angles = np.radians(np.maximum(np.arange(31) - 10, 0))  # then 20 degrees on the spot
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angles)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(angles), -np.sin(angles)
    path = Trajectory(np.arange(31.0), poses)
    chosen = [int(np.abs(poses - T).sum((1, 2)).argmin()) for T in path.spread(0.1, 5.0)]
    assert chosen == [0, 4, 8, 16, 22, 28, 30]  # more than 10 cm, more than 5 degrees, the last
    assert Trajectory().spread(0.1, 5.0) == []
