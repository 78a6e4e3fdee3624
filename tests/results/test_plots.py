"""Pictures are made without a display, and what they show is what was measured."""

import runpy
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from saved_results import curve, write_result
from scipy.spatial.transform import Rotation

from edslam_ti.errors import DataError, EdSlamError
from edslam_ti.results.plots import align_to_truth, draw_results, plot_trajectory
from edslam_ti.results.window import show_results
from edslam_ti.trajectory import Trajectory, write_tum

pytestmark = pytest.mark.slow

VIEW_APP = Path(__file__).parents[2] / "apps" / "view.py"


def moved(trajectory: Trajectory, noise: float = 0.0) -> Trajectory:
    """Return the trajectory in another world frame, with position noise in metres."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [0.4, -0.2, 1.0]).as_matrix()
    T[:3, 3] = [1.0, 2.0, -3.0]
    poses = T @ trajectory.poses
    poses[:, :3, 3] += noise * np.random.default_rng(0).normal(size=(len(poses), 3))
    return Trajectory(trajectory.timestamps, poses)


def is_picture(path: Path, min_size: int = 200) -> bool:
    image = cv2.imread(str(path))
    return image is not None and min(image.shape[:2]) >= min_size and image.std() > 5


@pytest.fixture(scope="module")
def result_folder(tmp_path_factory) -> Path:
    return write_result(tmp_path_factory.mktemp("result"))


def test_alignment_undoes_a_rigid_motion() -> None:
    truth = curve()
    aligned = align_to_truth(moved(truth), truth)
    np.testing.assert_allclose(aligned.positions, truth.poses[:, :3, 3], atol=1e-9)
    assert aligned.ate_rmse < 1e-9


def test_alignment_keeps_scale_and_measures_noise() -> None:
    truth = curve(400)
    aligned = align_to_truth(moved(truth, noise=0.01), truth)
    # The rmse of isotropic noise is sigma sqrt(3), less the six fitted numbers.
    assert aligned.ate_rmse == pytest.approx(0.01 * np.sqrt(3), rel=0.1)


def test_alignment_agrees_with_evo() -> None:
    from evo.core import metrics, sync
    from evo.core.trajectory import PoseTrajectory3D

    truth, estimate = curve(), moved(curve(), noise=0.02)
    reference = PoseTrajectory3D(poses_se3=list(truth.poses), timestamps=truth.timestamps)
    other = PoseTrajectory3D(poses_se3=list(estimate.poses), timestamps=estimate.timestamps)
    reference, other = sync.associate_trajectories(reference, other)
    other.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, other))
    expected = ape.get_statistic(metrics.StatisticsType.rmse)
    assert align_to_truth(estimate, truth).ate_rmse == pytest.approx(expected, rel=1e-9)


def test_poses_outside_the_truth_have_no_error() -> None:
    truth = curve()
    longer = Trajectory(np.append(truth.timestamps, 9.0), np.concatenate([truth.poses, np.eye(4)[None]]))
    errors = align_to_truth(longer, truth).errors
    assert np.isnan(errors[-1])
    assert np.isfinite(errors[:-1]).all()


def test_camera_that_stood_still_is_drawn(tmp_path: Path) -> None:
    still = Trajectory(np.arange(5.0), np.tile(np.eye(4), (5, 1, 1)))
    assert align_to_truth(still, still).ate_rmse < 1e-9
    plot_trajectory(tmp_path / "trajectory.png", {"ed_slam": still}, still)
    assert is_picture(tmp_path / "trajectory.png")


@pytest.mark.parametrize("with_truth", [True, False])
@pytest.mark.parametrize("names", [["ed_slam"], ["ed_slam", "open3d_rgbd"]])
def test_trajectory_plot_is_a_picture(tmp_path: Path, with_truth: bool, names: list[str]) -> None:
    path = tmp_path / "trajectory.png"
    plot_trajectory(path, {name: moved(curve(), 0.01) for name in names}, curve() if with_truth else None)
    assert is_picture(path)
    assert list(tmp_path.iterdir()) == [path]


def test_plot_of_one_pose_is_a_picture(tmp_path: Path) -> None:
    one = Trajectory(np.zeros(1), np.eye(4)[None])
    plot_trajectory(tmp_path / "trajectory.png", {"ed_slam": one}, curve())
    assert is_picture(tmp_path / "trajectory.png")


def test_plot_without_poses_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="at least one trajectory"):
        plot_trajectory(tmp_path / "trajectory.png", {"ed_slam": Trajectory()}, curve())
    assert list(tmp_path.iterdir()) == []


def test_finished_runs_are_drawn_into_one_picture(result_folder: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    write_tum(moved(curve()), bare / "trajectory_tum.txt")  # a run that mapped nothing
    draw_results([result_folder, bare], tmp_path / "runs.png")
    assert is_picture(tmp_path / "runs.png", min_size=600)


def test_run_without_mesh_is_drawn_by_its_points(result_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "points_only"
    folder.mkdir()
    for name in ("trajectory_tum.txt", "points.ply"):
        (folder / name).write_bytes((result_folder / name).read_bytes())
    draw_results([folder], tmp_path / "run.png")
    assert is_picture(tmp_path / "run.png", min_size=600)


def test_nothing_to_draw_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="at least one"):
        draw_results([], tmp_path / "runs.png")


def test_window_of_results_without_display_is_a_clear_error(result_folder: Path, monkeypatch) -> None:
    if not sys.platform.startswith("linux"):
        pytest.skip("displays are announced by the environment on Linux only")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(EdSlamError, match="no display"):
        show_results([result_folder])


def test_view_app_saves_a_picture(result_folder: Path, tmp_path: Path, capsys) -> None:
    app = runpy.run_path(str(VIEW_APP))
    app["main"]([str(result_folder), "--save", str(tmp_path / "run.png")])
    assert is_picture(tmp_path / "run.png", min_size=600)
    assert "run.png" in capsys.readouterr().out


def test_view_app_refuses_other_folders_in_one_line(tmp_path: Path) -> None:
    command = [sys.executable, str(VIEW_APP), str(tmp_path), "--save", str(tmp_path / "run.png")]
    refused = subprocess.run(command, capture_output=True, text=True, check=False)
    assert refused.returncode == 1
    assert "not a results folder" in refused.stderr
    assert len(refused.stderr.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
