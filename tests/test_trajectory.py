"""Paths over time: interpolation, prediction, and the TUM format."""

from pathlib import Path
from typing import Any

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


def test_evo_reads_the_tum_file(tmp_path: Path) -> None:
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


def test_rows_are_sorted_repeated_times_left_out_and_both_are_said(tmp_path: Path) -> None:
    file = tmp_path / "t.txt"
    file.write_text(
        "# t x y z\n0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n1 9 0 0 0 0 0 1\n0.5 0.6 0 0 0 0 0 1\n2 2 0 0 0 0 0 1\n"
    )
    notes: list[str] = []
    path = read_tum(file, notes)
    assert path.timestamps.tolist() == [0, 0.5, 1, 2]
    assert path.poses[:, 0, 3].tolist() == [0, 0.6, 1, 2]
    assert notes == [
        f"{file}: 1 of 5 rows repeat a time stamp (the first in line 4) and are left out",
        f"{file}: 1 of 5 rows are not in the order of time (the first in line 5); sorted",
    ]


def test_repairs_go_to_the_log(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = constant_velocity(np.linspace(0, 5, 20))
    write_tum(path, tmp_path / "t.txt")
    lines = (tmp_path / "t.txt").read_text().splitlines()
    for order in (np.arange(20)[::-1], np.random.default_rng(0).permutation(20)):
        (tmp_path / "t.txt").write_text("\n".join(lines[k + 1] for k in order))
        np.testing.assert_allclose(read_tum(tmp_path / "t.txt").poses, path.poses, atol=2e-9)
    assert "rows are not in the order of time" in caplog.text


@pytest.mark.parametrize(
    ("delay", "message"),
    [(0.0, r"line 21: a second pose for 0 s, 0\.5 m from that in line 1, and 19 more such lines"),
     (0.1, r"line 21: time goes back to 0\.1 s, and in the order of time the path would be")],
)  # fmt: skip
def test_two_recordings_in_one_file_are_refused(tmp_path: Path, delay: float, message: str) -> None:
    rows = [
        f"{0.25 * k + d:.3f} {0.01 * k} {y} 0 0 0 0 1\n"
        for y, d in ((0, 0.0), (0.5, delay))
        for k in range(20)
    ]
    (tmp_path / "t.txt").write_text("".join(rows))
    with pytest.raises(DataError, match=message + r".*two recordings in one file"):
        read_tum(tmp_path / "t.txt")


def test_stamps_since_the_epoch_survive_to_the_microsecond(tmp_path: Path) -> None:
    from evo.tools.file_interface import read_tum_trajectory_file

    offset = 1642650000.0
    path = constant_velocity(np.array([0.00066, 0.05, 0.100001]))
    write_tum(path, tmp_path / "t.txt", time_offset=offset)
    stamps = [line.split()[0] for line in (tmp_path / "t.txt").read_text().splitlines()[1:]]
    assert stamps == ["1642650000.000660000", "1642650000.050000000", "1642650000.100001000"]
    for back in (read_tum(tmp_path / "t.txt").timestamps,
                 read_tum_trajectory_file(str(tmp_path / "t.txt")).timestamps):  # fmt: skip
        np.testing.assert_allclose(back - offset, path.timestamps, rtol=0, atol=5e-7)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: "\ufeff" + text,
        lambda text: "# caf\udce9\n#! x\n\n" + text.replace("\n", "  # end\n"),
        lambda text: text.replace(" ", "\t  "),
    ],
)
def test_line_ends_comments_and_byte_order_marks_are_passed_over(tmp_path: Path, change: Any) -> None:
    path = constant_velocity(np.linspace(0, 5, 20))
    write_tum(path, tmp_path / "t.txt")
    text = change("\n".join((tmp_path / "t.txt").read_text().splitlines()[1:]) + "\n")
    (tmp_path / "t.txt").write_bytes(text.encode("utf-8", "surrogateescape"))
    np.testing.assert_allclose(read_tum(tmp_path / "t.txt").poses, path.poses, atol=2e-9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "expected lines 't tx .*', got an empty file"),
        ("# nothing\n", "expected lines 't tx .*', got an empty file"),
        ("0 1 2 3\n", "line 1: expected 8 numbers a line 't tx .*', got 4: '0 1 2 3'"),
        ("a b c d e f g h\n", "line 1: expected 8 numbers a line .*, got 'a'"),
        ("0 0 0 0 0 0 0 1\n\n1 0 0\n", "line 3: expected 8 numbers a line .*, got 3"),
        ("0,0,0,0,0,0,0,1\n", "line 1: expected 8 .* with blanks between them, got commas"),
        ("0 nan 0 0 0 0 0 1\n", "line 1: expected 8 .* finite .* got nan"),
        ("0 1e400 0 0 0 0 0 1\n", "line 1: expected 8 .* finite .* got 1e400"),
        ("0 0 0 0 0 0 0 1\n1e308 1 0 0 0 0 0 1\n", "line 2: .* below 1e\\+20, got 1e308"),
        ("0 1e19 0 0 0 0 0 1\n", "line 1: expected a position in metres, got 1e\\+19, 0, 0"),
        ("0 1_0 0 0 0 0 0 1\n", "line 1: .* got '1_0'"),
        ("0 \u0663 0 0 0 0 0 1\n", "line 1: .* got '\u0663'"),
        ("0 0 0 0 0 0 0 0\n", "line 1: expected a unit quaternion qx qy qz qw, got one of norm 0"),
        ("# t\n0 0 0 0 0 0 0 1e19\n", "line 2: expected a unit quaternion .* norm 1e\\+19"),
        ("0 0 0 0 \0 0 0 1\n", "line 1: .* got zero bytes"),
        ("1 " * 100_000, "line 1: expected 8 numbers a line .*, got 100000: '1 1 .* \\.\\.\\.'"),
    ],
)
def test_broken_tum_files_are_refused_in_one_line(tmp_path: Path, content: str, message: str) -> None:
    file = tmp_path / "t.txt"
    file.write_text(content, encoding="utf-8")
    with pytest.raises(DataError, match=message) as caught:
        read_tum(file)
    assert len(str(caught.value)) < 1001
    assert str(caught.value).isprintable()


def test_absent_and_binary_tum_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="absent"):
        read_tum(tmp_path / "absent.txt")
    (tmp_path / "wide.txt").write_text("0 0 0 0 0 0 0 1\n", encoding="utf-16")
    with pytest.raises(DataError, match=r"wide\.txt: .* UTF-16; save it as UTF-8"):
        read_tum(tmp_path / "wide.txt")
    (tmp_path / "binary.txt").write_bytes(bytes(range(128, 256)))
    with pytest.raises(DataError, match=r"binary\.txt"):
        read_tum(tmp_path / "binary.txt")


def test_spread_poses_differ_in_position_or_direction() -> None:
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
