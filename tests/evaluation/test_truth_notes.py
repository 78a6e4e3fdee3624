"""What looks wrong with a truth is named, each thing in one line; a right truth has no line."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edslam_ti.errors import DataError
from edslam_ti.evaluation.trajectories import trajectory_errors
from edslam_ti.evaluation.truth_notes import truth_notes
from edslam_ti.trajectory import Trajectory, read_tum
from edslam_ti.truth import true_poses_at

NUM = 60
TIMES = 0.05 * np.arange(NUM)
POSITIONS = np.stack([np.sin(TIMES), 0.5 * np.cos(1.3 * TIMES), 0.3 * TIMES], -1)
ROTATIONS = Rotation.from_euler("xyz", np.stack([0.2 * np.sin(TIMES), 0.3 * TIMES, 0.1 * np.cos(TIMES)], -1))

MOUNTED = Rotation.from_euler("xyz", [90, 20, 0], degrees=True)
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def path_of(
    positions: np.ndarray = POSITIONS, rotations: Rotation = ROTATIONS, times: np.ndarray = TIMES
) -> Trajectory:
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = rotations.as_matrix()
    poses[:, :3, 3] = positions
    return Trajectory(times, poses)


def noisy(metres: float = 1e-3, radians: float = 1e-3) -> Trajectory:
    random = np.random.default_rng(0)
    turned = ROTATIONS * Rotation.from_rotvec(radians * random.standard_normal((NUM, 3)))
    return path_of(POSITIONS + metres * random.standard_normal((NUM, 3)), turned)


def notes_of(estimate: Trajectory, truth: Trajectory, time_offset: float = 0.0) -> list[str]:
    return truth_notes(estimate, truth, trajectory_errors(estimate, truth), time_offset)


def changed(change: Callable[[np.ndarray], np.ndarray]) -> Trajectory:
    return Trajectory(TIMES, change(path_of().poses))


@pytest.mark.parametrize(("metres", "radians"), [(0, 0), (2e-4, 1e-4), (1e-3, 1e-3), (0.1, 0.03)])
def test_right_truth_has_no_line(metres: float, radians: float) -> None:
    assert notes_of(noisy(metres, radians), path_of()) == []


def test_estimate_that_is_wrong_is_not_the_truths_fault() -> None:
    still = path_of(np.zeros((NUM, 3)), Rotation.identity(NUM))
    assert notes_of(still, path_of()) == []
    drifting = path_of(POSITIONS + 0.1 * TIMES[:, None] ** 2)
    assert notes_of(drifting, path_of()) == []


@pytest.mark.parametrize("extent", [0.0, 1e-25, 1e-8, 1e-6, 1e-4])  # m
def test_turn_on_the_spot_has_no_scale(extent: float) -> None:
    random = np.random.default_rng(1)
    truth = path_of(extent * POSITIONS)
    estimate = path_of(extent * POSITIONS + 2e-4 * random.standard_normal((NUM, 3)))
    errors = trajectory_errors(estimate, truth)
    assert not any("scale" in line for line in truth_notes(estimate, truth, errors))
    if extent < 1e-7:
        assert errors.scale == 1


def test_scale_that_explains_the_error_is_named() -> None:
    [line] = notes_of(
        path_of(POSITIONS / 5 + 1e-3 * np.random.default_rng(0).normal(size=(NUM, 3))), path_of()
    )
    assert line.startswith("a scale of 5")
    assert "check depth_scale" in line
    [line] = notes_of(changed(lambda T: T * np.array([1, 1, 1, 1.02])), path_of())
    assert line.startswith("a scale of 0.9804 explains it (the estimate is 1.02 times as large as the truth)")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda T: path_of(rotations=Rotation.from_quat(ROTATIONS.as_quat()[:, [3, 0, 1, 2]])).poses,
            "orientations look wrong: the truth's look like quaternions wxyz, read as xyzw; then ATE",
        ),
        (np.linalg.inv, "poses look inverted: the truth's look like inverted poses (world-to-camera)"),
        (lambda T: T @ OPENGL, "look like OpenGL's axes"),
        (
            lambda T: np.linalg.inv(T @ OPENGL),
            "inverted poses (world-to-camera) in OpenGL's axes",
        ),
        (
            lambda T: path_of(rotations=ROTATIONS.inv()).poses,
            "look like rotations from the world to the camera",
        ),
        (
            lambda T: path_of(rotations=ROTATIONS * MOUNTED).poses,
            "look like poses of another frame, turned by",
        ),
    ],
)
@pytest.mark.parametrize("noise", [2e-4, 0.01])
def test_convention_that_explains_the_orientations_is_named(
    change: Callable[[np.ndarray], np.ndarray], words: str, noise: float
) -> None:
    [line] = notes_of(noisy(noise, noise), changed(change))
    assert words in line


def test_high_rpe_is_said_in_numbers() -> None:
    turned = ROTATIONS * Rotation.from_rotvec(np.random.default_rng(1).normal(0, 0.7, (NUM, 3)))
    [line] = notes_of(noisy(2e-4), path_of(rotations=turned))
    assert line.startswith("RPE is ")
    assert "orientations look wrong (wxyz for xyzw, OpenGL axes, or the body's frame" in line


def test_clock_that_is_off_is_named(shared_data: Path) -> None:
    file = shared_data / "trajectories" / "tum_vie_6dof.txt"
    if not file.is_file():
        pytest.skip(f"{file} is not here")
    truth = read_tum(file)
    times = np.arange(4, 16, 1 / 30)
    poses, is_known = true_poses_at(truth, times)
    estimate = Trajectory(times[is_known], poses[is_known])
    for shift, words in ((0.03, "30 ms late"), (-0.01, "10 ms early"), (0.0, None)):
        lines = notes_of(estimate, Trajectory(truth.timestamps + shift, truth.poses))
        assert [f"truth looks {words}: " in line for line in lines] == ([] if words is None else [True])


def test_holes_are_counted_with_their_times() -> None:
    keep = (TIMES < 0.8) | (TIMES > 2.2)
    truth = Trajectory(TIMES[keep], path_of().poses[keep])
    [line] = notes_of(noisy(), truth, time_offset=1000.0)
    assert line.startswith(
        "truth is missing for 1.5 of 2.95 s (longest from 1000.750 to 1002.250 s): 31 of 60"
    )
    few = Trajectory(TIMES[:5], path_of().poses[:5])
    assert notes_of(noisy(), few)[-1].startswith("only 5 of 60 poses are compared with the truth")


def test_holes_do_not_enter_the_errors() -> None:
    keep = (TIMES < 0.8) | (TIMES > 1.2)
    truth = Trajectory(TIMES[keep], path_of().poses[keep])
    errors = trajectory_errors(path_of(), truth)
    assert errors.num_poses == keep.sum()
    assert errors.coverage == pytest.approx(keep.mean())
    assert errors.ate_max_cm < 1e-6
    assert len(errors.motion_errors_cm) == keep.sum() - 2  # the motion across the hole is of no frame


def test_jump_is_counted_and_left_out() -> None:
    poses = path_of().poses
    poses[20, 0, 3] += 100
    truth = Trajectory(TIMES, poses)
    assert trajectory_errors(noisy(), truth).ate_rmse_cm < 0.2
    line = notes_of(noisy(), truth)[0]
    assert line.startswith(
        "truth: 1 pose jumps away from the rest of its path (the first at 1.000 s, by 100 m)"
    )


def test_slow_truth_is_no_better_than_its_interpolation() -> None:
    times = TIMES[:-1] + 0.025
    poses = np.stack([path_of().at(t) for t in times])
    poses[:, :3, 3] += np.random.default_rng(0).normal(0, 1e-4, (NUM - 1, 3))
    [line] = notes_of(Trajectory(times, poses), path_of())
    assert line.startswith("truth comes every 50 ms: half way between, its interpolation is off by about 0.0")


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (1e9 * TIMES, "looks as if it were in nanoseconds"),
        (1e6 * TIMES, "looks as if it were in microseconds"),
        (1e3 * TIMES, "looks as if it were in milliseconds"),
        (1e9 * (TIMES + 1.6e9), "looks as if it were in nanoseconds"),
        (TIMES + 100, "They begin 100 s apart"),
        (TIMES + 1.6e9, "They begin 1.6e+09 s apart"),
        (np.r_[-100.0, 1.5, 100 + TIMES[2:]], "The truth has 1 poses in that time"),
    ],
)
def test_other_clocks_are_refused_in_one_line(times: np.ndarray, words: str) -> None:
    with pytest.raises(DataError, match=r"expected at least 3 poses .*, on one clock\?") as refused:
        trajectory_errors(noisy(), path_of(times=times))
    assert words in str(refused.value)
    assert len(str(refused.value)) < 400
    if "nano" in words:
        with pytest.raises(DataError, match="The estimate looks as if it were in nanoseconds"):
            trajectory_errors(path_of(times=times), noisy())


@pytest.mark.parametrize("value", [1e200, 1e9, np.nan, np.inf])
def test_positions_that_are_no_metres_are_refused_in_one_line(value: float) -> None:
    poses = path_of().poses
    poses[7, 1, 3] = value
    with pytest.raises(
        DataError, match=r"estimate: expected positions in metres, got .* \(pose 8, and 0 more"
    ):
        trajectory_errors(Trajectory(TIMES, poses), path_of())
    assert (
        trajectory_errors(path_of(), Trajectory(TIMES, poses)).num_poses == NUM - 1
    )  # left out of the truth
    poses[:, :3, 3] = value
    with pytest.raises(DataError, match="truth: expected positions in metres"):
        trajectory_errors(path_of(), Trajectory(TIMES, poses))


def test_lost_poses_say_nothing_about_the_clock() -> None:
    def positions(times: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(4 * times), np.cos(5 * times), times], -1)

    is_lost = np.arange(NUM) > NUM // 4
    truth = path_of(positions(TIMES))
    estimate = path_of(positions(np.where(is_lost, TIMES - 0.1, TIMES)))  # lost: its pose lags behind
    errors = trajectory_errors(estimate, truth)
    assert "early" in " ".join(truth_notes(estimate, truth, errors))
    assert truth_notes(estimate, truth, errors, lost=np.flatnonzero(is_lost).tolist()) == []
