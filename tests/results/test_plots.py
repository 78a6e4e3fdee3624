"""Pictures are made without a display, and what they show is what was measured."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError, EdSlamError
from edslam_ti.results.export import fuse_mesh, write_mesh, write_points
from edslam_ti.results.plots import align_to_truth, draw_results, plot_trajectory
from edslam_ti.results.reading import load_result
from edslam_ti.results.window import show_results
from edslam_ti.trajectory import Trajectory, write_tum

CAMERA = Camera(width=80, height=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
VIEW_APP = Path(__file__).parents[2] / "apps" / "view.py"


def curve(count: int = 40) -> Trajectory:
    times = np.linspace(0, 2, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.stack([np.sin(times), 0.1 * times, 0.3 * np.cos(2 * times)], -1)
    poses[:, :3, :3] = Rotation.from_rotvec(times[:, None] * [0, 0.2, 0]).as_matrix()
    return Trajectory(times, poses)


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
    folder = tmp_path_factory.mktemp("result")
    write_tum(curve(), folder / "trajectory_tum.txt")
    (folder / "metrics.json").write_text(
        json.dumps({"scene": "office0", "method": "ed_slam", "ate_rmse_cm": 0.42})
    )
    y, x = np.mgrid[0:60, 0:80]
    brightness = 0.5 + 0.4 * np.sin(x / 5) * np.cos(y / 7)
    view = (np.full(CAMERA.shape, 1.5, np.float32), brightness, curve().pose(0))
    write_mesh(folder / "mesh.ply", fuse_mesh([view], CAMERA, voxel_size=0.03))
    points = np.random.default_rng(0).normal(size=(500, 3)) * 0.3 + [0, 0, 1.5]
    write_points(folder / "points.ply", points, np.linspace(0, 1, 500))
    return folder


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


def test_result_has_a_title_with_its_error(result_folder: Path) -> None:
    result = load_result(result_folder)
    assert result.title == "office0 ed_slam: ATE 0.42 cm rmse"
    assert result.mesh is not None
    assert result.points is not None
    assert len(result.points) == 500


def test_folder_that_is_no_result_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not a results folder"):
        load_result(tmp_path)
    with pytest.raises(FileNotFoundError, match="results folder not found"):
        load_result(tmp_path / "absent")
    with pytest.raises(DataError, match="at least one"):
        draw_results([], tmp_path / "runs.png")


@pytest.mark.parametrize("name", ["points.ply", "mesh.ply", "metrics.json"])
def test_broken_parts_of_a_result_are_named(result_folder: Path, tmp_path: Path, name: str) -> None:
    write_tum(curve(), tmp_path / "trajectory_tum.txt")
    (tmp_path / name).write_bytes(b"garbage")
    with pytest.raises(DataError, match=name):
        load_result(tmp_path)


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
