"""Whole runs on the tiny room, from a folder of events and depth to a folder of results."""

import csv
import io
import json
import os
import re
import runpy
import shutil
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from rich.console import Console
from sequences import settings

from edslam_ti import frame_loop, pipeline
from edslam_ti.command_line import UsageError, launch
from edslam_ti.config import Config
from edslam_ti.datasets import Sample, SampledSequence
from edslam_ti.errors import DataError
from edslam_ti.evaluation import trajectories as evaluation
from edslam_ti.mapping.gaussian_mapper import GaussianMapper
from edslam_ti.mapping.gaussian_ply import read_gaussian_ply
from edslam_ti.pipeline import held_out_frames, run
from edslam_ti.results import folder as results
from edslam_ti.results.reading import require_tracked
from edslam_ti.slam import Slam
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.trajectory import read_tum

pytestmark = pytest.mark.slow  # whole runs, or processes of their own


ROOT = Path(__file__).parents[1]
FEW = {"iterations": 1, "final_iterations": 10}
ARTEFACTS = {
    *("trajectory_tum.txt", "trajectory_frontend_tum.txt", "truth_tum.txt", "poses.csv", "trajectory.png"),
    *("map.ply", "mesh.ply", "points.ply", "flythrough.mp4"),
    *("config.yaml", "metrics.json", "log.txt", "renders", "journal.csv", "run.json"),
    *("index.html", "camera.json", "sensor.png"),
}
KEYS = {
    *("dataset", "scene", "method", "ate_rmse_cm", "ate_mean_cm", "ate_rmse_sim3_cm", "rpe_trans_cm"),
    *("rpe_rot_deg", "psnr_db", "psnr_corrected_db", "ssim_corrected", "lpips_corrected", "depth_l1_cm"),
    *("num_frames", "num_lost_frames", "num_gaussians", "num_events", "tracking_hz", "total_fps"),
    *("wall_s", "peak_memory_mb", "device", "protocol"),
}

# All of metrics.json, in its order: people's scripts read it.
NAMES = [
    *("dataset", "scene", "description", "method", "ate_rmse_cm", "ate_mean_cm", "ate_median_cm"),
    *("ate_max_cm", "ate_rmse_sim3_cm", "rpe_trans_cm", "rpe_rot_deg", "ate_frontend_rmse_cm"),
    *("path_length_m", "ate_scale_sim3", "num_truth_poses_compared", "truth_coverage", "truth_notes"),
    *("psnr_db", "psnr_corrected_db", "ssim_corrected", "lpips_corrected", "psnr_db_all"),
    *("psnr_corrected_db_all", "ssim_corrected_all", "lpips_corrected_all", "ssim_all", "lpips_all"),
    *("depth_l1_cm", "num_held_out_views", "psnr_mapped_db", "psnr_mapped_corrected_db"),
    *("ssim_mapped_corrected", "lpips_mapped_corrected", "psnr_mapped_db_all"),
    *("psnr_mapped_corrected_db_all", "ssim_mapped_corrected_all", "lpips_mapped_corrected_all"),
    *("ssim_mapped_all", "lpips_mapped_all", "depth_l1_mapped_cm", "num_mapped_views", "psnr_novel_db"),
    *("psnr_novel_corrected_db", "ssim_novel_corrected", "lpips_novel_corrected", "psnr_novel_db_all"),
    *("psnr_novel_corrected_db_all", "ssim_novel_corrected_all", "lpips_novel_corrected_all"),
    *("ssim_novel_all", "lpips_novel_all", "depth_l1_novel_cm", "num_novel_views", "mesh_accuracy_cm"),
    *(
        "mesh_completion_cm",
        "mesh_completion_ratio_5cm",
        "time_offset_s",
        "num_frames",
        "num_lost_frames",
        "num_keyframes",
    ),
    *("num_gaussians", "num_events", "num_mapping_steps", "num_hot_pixels"),
    *("sigma_position_median_cm", "sigma_position_end_cm", "sigma_rotation_median_deg"),
    *("depth_delay_ms", "depth_delay_sigma_ms", "event_depth_disagreement", "lost_share", "problems"),
    *("num_dropped_events", "data_notes", "contrast_threshold"),
    *("contrast_threshold_source", "contrast_threshold_positive", "contrast_threshold_negative"),
    *("contrast_threshold_deviation", "tracking_hz", "tracking_s", "mapping_s", "refinement_s", "device"),
    *("version", "is_interrupted", "protocol", "protocols", "sensor"),
    *("seconds_per_frame", "wall_s", "total_fps", "peak_memory_mb"),
]


@pytest.fixture(scope="module", autouse=True)
def taichi_is_started_once() -> Any:
    """Runs start Taichi themselves, which recompiles every kernel; here it runs already."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline.kernels, "init", lambda *arguments, **options: None)
        yield


def config_for(recording: Path, out: Path, method: str = "ed_slam", **differences: Any) -> Config:
    """Return quick settings for a recording."""
    mapping = FEW | differences.pop("mapping", {})
    places = {"scene": recording.name, "dataset": "event_replica", "data_dir": recording.parent, "out": out}
    return settings(method, **places, mapping=mapping, **differences)


def quiet_run(config: Config) -> Path:
    return run(config, Console(file=io.StringIO()))


def metrics_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "metrics.json").read_text())


def leftovers(out: Path) -> list[Path]:
    return [p for p in out.rglob("*") if "partial" in p.name or p.name.endswith(".old")]


@pytest.fixture(scope="module")
def result(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return quiet_run(config_for(tiny_folder, tmp_path_factory.mktemp("results")))


@pytest.fixture
def recording(tiny_folder: Path, tmp_path: Path) -> Path:
    """A copy of the recording to be changed."""
    return Path(shutil.copytree(tiny_folder, tmp_path / "data" / "changed"))


# --- what a run leaves behind ---


def test_every_artefact_is_there_and_holds_something(result: Path) -> None:
    assert {path.name for path in result.iterdir()} == ARTEFACTS
    assert all(path.stat().st_size > 0 for path in result.iterdir())
    assert result.parts[-4:-1] == ("event_replica", "tiny", "ed_slam")
    assert leftovers(result.parents[3]) == []


def test_latest_points_to_the_result(result: Path) -> None:
    latest = result.parent / "latest"
    assert latest.is_symlink()
    assert latest.resolve() == result.resolve()
    assert not latest.readlink().is_absolute()  # results may be moved


def test_metrics_have_every_key_and_are_right(result: Path) -> None:
    metrics = metrics_of(result)
    assert list(metrics) == NAMES
    assert metrics.keys() >= KEYS
    assert (metrics["dataset"], metrics["scene"], metrics["method"]) == ("event_replica", "tiny", "ed_slam")
    assert metrics["num_frames"] == 14
    assert metrics["num_lost_frames"] == 0
    assert metrics["num_events"] > 50_000
    assert metrics["num_gaussians"] >= 2400
    assert metrics["num_mapping_steps"] >= 10
    assert metrics["num_hot_pixels"] == 0
    assert metrics["ate_rmse_cm"] < 0.2
    assert metrics["path_length_m"] == pytest.approx(0.2, abs=0.05)
    assert 10 < metrics["psnr_corrected_db"] < 40
    assert 0 < metrics["depth_l1_cm"] < 20
    assert metrics["num_held_out_views"] == 3
    numbers = KEYS - {"dataset", "scene", "method", "device", "protocol", "lpips_corrected"}
    assert all(isinstance(metrics[key], int | float) for key in numbers)
    assert not metrics["is_interrupted"]


def test_tracked_poses_are_saved_in_addition_to_the_corrected_ones(result: Path) -> None:
    final, tracked = (read_tum(result / f"trajectory{name}_tum.txt") for name in ("", "_frontend"))
    np.testing.assert_allclose(tracked.timestamps, final.timestamps)
    moved = np.abs(tracked.poses[:, :3, 3] - final.poses[:, :3, 3]).max()  # by bundle adjustment
    assert 0 < moved < 0.01
    assert 0 < metrics_of(result)["ate_frontend_rmse_cm"] < 0.2


def test_every_stage_has_its_time(result: Path) -> None:
    seconds = metrics_of(result)["seconds_per_frame"]
    assert list(seconds) == ["tracking", "mapping", "refinement", "saving"]
    assert all(value > 0 for value in seconds.values())
    assert 14 * sum(seconds.values()) <= metrics_of(result)["wall_s"]
    assert "seconds per frame: tracking" in (result / "log.txt").read_text()


def test_trajectory_and_truth_have_a_pose_per_frame(result: Path) -> None:
    estimate, truth = (read_tum(result / name) for name in ("trajectory_tum.txt", "truth_tum.txt"))
    assert len(estimate) == 14
    np.testing.assert_allclose(estimate.timestamps, truth.timestamps)
    np.testing.assert_allclose(estimate.poses[:, :3, 3], truth.poses[:, :3, 3], atol=0.005)


def test_map_holds_the_gaussians_that_were_counted(result: Path) -> None:
    splats = read_gaussian_ply(result / "map.ply")
    assert len(splats["means"]) == metrics_of(result)["num_gaussians"]
    low, high = splats["means"].min(0), splats["means"].max(0)
    assert (low > -0.2).all()  # the room: 3 m x 3 m x 2.4 m
    assert (high < [3.2, 3.2, 2.6]).all()


def test_renders_are_of_held_out_and_novel_views(result: Path) -> None:
    names = {path.name for path in (result / "renders").iterdir()}
    held_out = ["000150.png", "000400.png", "000650.png"]  # ms; every fifth from the third on
    novel = [f"novel_{ms:06d}.png" for ms in (88, 262, 438, 612)]
    assert names == {*held_out, *novel, "contact.png", "views.csv"}
    one, sheet = (cv2.imread(str(result / "renders" / name)) for name in ("000150.png", "contact.png"))
    assert one.shape[1] > 4 * 360  # truth | render | error | depth, enlarged threefold
    assert sheet.shape[0] > 7 * 160  # 3 + 4 views, enlarged twofold


def test_mapped_held_out_and_novel_views_are_reported_separately(result: Path) -> None:
    metrics = metrics_of(result)
    for suffix, kind, count in (("", "held_out", 3), ("_mapped", "mapped", 3), ("_novel", "novel", 4)):
        assert metrics[f"num_{kind}_views"] == count
        assert 10 < metrics[f"psnr{suffix}_corrected_db"] < 40
        assert 0 < metrics[f"ssim{suffix}_corrected"] < 1
        assert 0 < metrics[f"depth_l1{suffix}_cm"] < 20
    with (result / "renders" / "views.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["views"] for row in rows] == ["held out"] * 3 + ["mapped"] * 3 + ["novel"] * 4
    held_out = [float(row["depth_l1_cm"]) for row in rows[:3]]
    assert np.mean(held_out) == pytest.approx(metrics["depth_l1_cm"], rel=0.05)
    errors = [10 ** (-float(row["psnr_corrected_db"]) / 10) for row in rows[:3]]
    assert -10 * np.log10(np.mean(errors)) == pytest.approx(metrics["psnr_corrected_db"], abs=0.05)


def test_mesh_is_compared_with_the_true_surfaces(result: Path) -> None:
    metrics = metrics_of(result)
    assert 0 < metrics["mesh_accuracy_cm"] < 5  # images of 120 x 80 pixels: 4 cm a pixel
    assert 0 < metrics["mesh_completion_cm"] < 10
    assert 0.6 < metrics["mesh_completion_ratio_5cm"] <= 1


def test_evaluate_measures_the_same_mesh_from_files(
    result: Path, tiny_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    app = runpy.run_path(str(ROOT / "apps" / "evaluate.py"))
    paths = [str(result / name) for name in ("trajectory_tum.txt", "truth_tum.txt")]
    app["main"]([*paths, "--mesh", str(result / "mesh.ply"), "--recording", str(tiny_folder)])
    printed = capsys.readouterr().out.splitlines()[-1]
    metrics = metrics_of(result)
    numbers = [float(word) for word in re.findall(r"[0-9.]+", printed)]
    expected = [metrics["mesh_accuracy_cm"], metrics["mesh_completion_cm"]]
    assert numbers[:2] == pytest.approx(expected, abs=0.01)  # files hold fewer digits
    assert numbers[2] == pytest.approx(100 * metrics["mesh_completion_ratio_5cm"], abs=0.1)
    with pytest.raises(UsageError, match="expected both or neither"):
        app["main"]([*paths, "--mesh", str(result / "mesh.ply")])


def test_fly_through_is_a_video_of_render_and_depth(result: Path) -> None:
    video = cv2.VideoCapture(str(result / "flythrough.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 10  # 0.65 s, 15 a second
    ok, frame = video.read()
    assert ok
    assert frame.shape == (80, 240, 3)


def test_both_protocols_are_named(result: Path) -> None:
    metrics = metrics_of(result)
    full, theirs = metrics["protocols"]["full"], metrics["protocols"]["inceventgs"]
    assert full["ate_rmse_cm"] == metrics["ate_rmse_cm"]
    assert full["psnr_corrected_db"] == metrics["psnr_corrected_db"]
    assert theirs["ate_rmse_sim3_cm"] == metrics["ate_rmse_sim3_cm"]
    assert theirs["psnr_corrected_db"] == metrics["psnr_corrected_db_all"]
    assert theirs["ssim"] == metrics["ssim_all"] != metrics["ssim_corrected_all"]
    assert "no slice of theirs" in theirs["trajectory"]


def test_slice_of_inceventgs_is_measured_apart(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(evaluation.INCEVENTGS_SLICES, "tiny", (1, 5))  # of every second pose: 0.1 to 0.5 s
    metrics = metrics_of(quiet_run(config_for(tiny_folder, tmp_path)))
    theirs = metrics["protocols"]["inceventgs"]
    assert theirs["trajectory"].startswith("their slice, 0.1 to 0.5 s")
    assert 0 < theirs["ate_rmse_sim3_cm"] != metrics["ate_rmse_sim3_cm"]
    assert 10 < theirs["psnr_corrected_db"] != metrics["psnr_corrected_db_all"]


def test_saved_settings_make_the_same_run(result: Path, tmp_path: Path) -> None:
    values = yaml.safe_load((result / "config.yaml").read_text())
    again = quiet_run(Config().updated(values | {"out": str(tmp_path)}))
    for name in ("trajectory_tum.txt", "map.ply"):
        assert (again / name).read_bytes() == (result / name).read_bytes(), name


def test_log_describes_the_run(result: Path) -> None:
    lines = (result / "log.txt").read_text().splitlines()
    assert "tiny: tiny test room, method ed_slam" in lines[0]
    assert any("first brightness image" in line for line in lines)
    assert lines[-1].endswith("saved")


def test_held_out_frames_have_depth_and_are_never_the_first() -> None:
    class Samples:
        has_depth = np.array([True, False, True, True, False, True, True, True])

    assert held_out_frames(Samples(), 3) == {2, 6}  # type: ignore[arg-type]


# --- other methods and settings ---


def test_tracking_alone_writes_no_map(tiny_folder: Path, tmp_path: Path) -> None:
    folder = quiet_run(config_for(tiny_folder, tmp_path, mapping={"enabled": False}))
    of_the_map = {"map.ply", "mesh.ply", "points.ply", "flythrough.mp4", "renders"}
    assert {p.name for p in folder.iterdir()} == ARTEFACTS - of_the_map
    metrics = metrics_of(folder)
    assert metrics["ate_rmse_cm"] < 0.2
    assert metrics["psnr_corrected_db"] is None
    assert metrics["num_gaussians"] == 0


@pytest.mark.parametrize(("is_mapping", "expected"), [(True, 6), (False, 0)])
def test_free_memory_is_given_back_after_every_mapped_frame(
    is_mapping: bool, expected: int, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []
    monkeypatch.setattr(frame_loop, "release_free_memory", lambda: calls.append(1))
    config = config_for(tiny_folder, tmp_path, duration=0.3, mapping={"enabled": is_mapping})
    assert metrics_of(quiet_run(config))["num_frames"] == 6
    assert len(calls) == expected


def test_open3d_baseline_goes_through_the_same_pipeline(tiny_folder: Path, tmp_path: Path) -> None:
    folder = quiet_run(config_for(tiny_folder, tmp_path, "open3d_rgbd"))
    assert {p.name for p in folder.iterdir()} == ARTEFACTS - {"map.ply"}  # it has no Gaussians
    metrics = metrics_of(folder)
    assert metrics["method"] == "open3d_rgbd"
    assert list(metrics) == NAMES
    assert metrics["num_keyframes"] is metrics["num_mapping_steps"] is metrics["num_hot_pixels"] is None
    assert metrics["ate_rmse_cm"] < 3
    assert metrics["psnr_db"] > 15  # it fuses the images themselves


def test_paper_method_runs_by_its_name(tiny_folder: Path, tmp_path: Path) -> None:
    folder = quiet_run(config_for(tiny_folder, tmp_path, "ed_slam_paper", mapping={"enabled": False}))
    assert folder.parent.name == "ed_slam_paper"
    assert yaml.safe_load((folder / "config.yaml").read_text())["tracking"]["depth_weight"] == 0


def test_true_poses_have_no_error(tiny_folder: Path, tmp_path: Path) -> None:
    folder = quiet_run(config_for(tiny_folder, tmp_path, poses="truth"))
    metrics = metrics_of(folder)
    assert metrics["ate_rmse_cm"] == 0
    assert "poses truth" in metrics["protocol"]


def test_lpips_weights_give_a_perceptual_distance(
    tiny_folder: Path, tmp_path: Path, shared_data: Path
) -> None:
    weights = next((shared_data / "lpips").glob("*.pt*"), None)
    if weights is None:
        pytest.skip(f"no weights in {shared_data / 'lpips'}")
    evaluation = {"lpips_weights": str(weights), "max_images": 1}
    folder = quiet_run(config_for(tiny_folder, tmp_path, evaluation=evaluation, duration=0.3))
    assert 0 < metrics_of(folder)["lpips_corrected"] < 1.5


# --- data that lacks something ---


def test_recording_of_events_and_depth_alone_runs_without_metrics(recording: Path, tmp_path: Path) -> None:
    shutil.rmtree(recording / "images")
    for name in ("poses_ts.txt", "traj.txt"):
        (recording / name).unlink()
    folder = quiet_run(config_for(recording, tmp_path))
    assert {p.name for p in folder.iterdir()} == ARTEFACTS - {"truth_tum.txt"}
    metrics = metrics_of(folder)
    for key in ("ate_rmse_cm", "ate_rmse_sim3_cm", "rpe_trans_cm", "psnr_db", "ssim_corrected"):
        assert metrics[key] is None, key
    assert metrics["depth_l1_cm"] > 0  # depth is there to compare with
    start = read_tum(folder / "trajectory_tum.txt").pose(0)
    np.testing.assert_allclose(start, np.eye(4), atol=1e-9)  # the world is the first camera


def test_true_poses_without_truth_are_an_error(recording: Path, tmp_path: Path) -> None:
    for name in ("poses_ts.txt", "traj.txt"):
        (recording / name).unlink()
    with pytest.raises(DataError, match="--poses truth needs true poses"):
        quiet_run(config_for(recording, tmp_path / "out", poses="truth"))
    assert not (tmp_path / "out").exists()


def test_depth_that_is_all_zero_is_refused_before_the_first_frame(recording: Path, tmp_path: Path) -> None:
    for path in (recording / "depth").iterdir():
        cv2.imwrite(str(path), np.zeros((80, 120), np.uint16))
    with pytest.raises(DataError, match="depth has no variation: every pixel is missing"):
        quiet_run(config_for(recording, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_depth_of_two_pixels_still_gives_a_trajectory(recording: Path, tmp_path: Path) -> None:
    depth = np.zeros((80, 120), np.uint16)
    depth[0, :2] = 5000, 9000
    for path in (recording / "depth").iterdir():
        cv2.imwrite(str(path), depth)
    folder = quiet_run(config_for(recording, tmp_path))
    assert len(read_tum(folder / "trajectory_tum.txt")) == 14
    assert metrics_of(folder)["num_lost_frames"] == 13  # nothing to align to


def test_a_map_that_is_empty_is_said_to_be(tiny_folder: Path, tmp_path: Path) -> None:
    nothing_stays = {"initial_opacity": 0.1, "min_opacity": 0.99}
    folder = quiet_run(config_for(tiny_folder, tmp_path, duration=0.3, mapping=nothing_stays))
    assert not (folder / "map.ply").exists()
    assert "the map is empty" in (folder / "log.txt").read_text()
    assert metrics_of(folder)["depth_l1_cm"] is None


def test_map_without_a_surface_keeps_its_other_results(tiny_folder: Path, tmp_path: Path) -> None:
    folder = quiet_run(config_for(tiny_folder, tmp_path, duration=0.3, mapping={"max_gaussians": 2}))
    assert {p.name for p in folder.iterdir()} == ARTEFACTS - {"mesh.ply"}
    assert "mesh.ply: no surface" in (folder / "log.txt").read_text()


def test_inverted_polarity_is_told_with_the_results(recording: Path, tmp_path: Path) -> None:
    (events_file,) = recording.glob("event_threshold_*/*.npy")
    events = np.load(events_file)
    events[:, 3] = 1 - events[:, 3] if events[:, 3].min() == 0 else -events[:, 3]
    np.save(events_file, events)
    folder = quiet_run(config_for(recording, tmp_path, mapping={"enabled": False}))
    [note] = metrics_of(folder)["data_notes"]
    assert note.startswith("polarity looks inverted")


def test_a_view_without_an_image_is_left_out_alone(recording: Path, tmp_path: Path) -> None:
    views = quiet_run(config_for(recording, tmp_path / "whole")) / "renders/views.csv"
    whole = [row.split(",") for row in views.read_text().splitlines() if row.startswith("held out")]
    assert len(whole) > 1
    (recording / f"images/frame{round(1000 * float(whole[0][1])):06d}.png").unlink()
    views = quiet_run(config_for(recording, tmp_path / "less")) / "renders/views.csv"
    less = [row.split(",") for row in views.read_text().splitlines() if row.startswith("held out")]
    assert [row[1] for row in less] == [row[1] for row in whole]
    assert less[0][2] == ""
    assert float(less[1][2]) > 10


# --- runs that end early ---


def interrupt_at(frame: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Press Ctrl-C while a frame is processed."""
    process: Callable[..., TrackingResult] = Slam.process

    def processed(self: Slam, sample: Sample, is_held_out: bool = False) -> TrackingResult:
        if len(self.results) == frame:
            signal.raise_signal(signal.SIGINT)
        return process(self, sample, is_held_out)

    monkeypatch.setattr(Slam, "process", processed)


def test_interrupt_saves_partial_results_and_exits_130(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(signal.SIGINT)
    interrupt_at(5, monkeypatch)
    config = config_for(tiny_folder, tmp_path)
    with pytest.raises(SystemExit) as stop:
        launch(lambda: print(run(config)))
    assert stop.value.code == 130
    assert "saving what there is" in capsys.readouterr().out
    folder = (tmp_path / "event_replica/tiny/ed_slam/latest").resolve()
    assert {p.name for p in folder.iterdir()} == ARTEFACTS | {"checkpoint"}
    metrics = metrics_of(folder)
    assert metrics["is_interrupted"]
    assert metrics["num_frames"] == 6  # the frame in hand is finished
    assert len(read_tum(folder / "trajectory_tum.txt")) == 6
    assert "interrupted" in (folder / "log.txt").read_text()
    assert leftovers(tmp_path) == []
    assert signal.getsignal(signal.SIGINT) is before


def test_interrupt_while_refining_stops_it(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = GaussianMapper.finish

    def finish(self: Any, trajectory: Any, progress: Callable[[float], bool]) -> None:
        signal.raise_signal(signal.SIGINT)
        original(self, trajectory, progress)

    monkeypatch.setattr(GaussianMapper, "finish", finish)
    config = config_for(tiny_folder, tmp_path, duration=0.3, mapping={"final_iterations": 100_000})
    with pytest.raises(KeyboardInterrupt):
        quiet_run(config)
    assert metrics_of(tmp_path / "event_replica/tiny/ed_slam/latest")["is_interrupted"]


def test_interrupt_before_the_first_frame_leaves_nothing(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: Any, **options: Any) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(pipeline, "own_sensor", interrupted)
    with pytest.raises(KeyboardInterrupt):
        quiet_run(config_for(tiny_folder, tmp_path))
    assert list(tmp_path.iterdir()) == []


# --- whatever ends a run ---


def fail_at(frame: int, error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    """Raise an exception when a frame is processed."""
    process: Callable[..., TrackingResult] = Slam.process

    def processed(self: Slam, sample: Sample, is_held_out: bool = False) -> TrackingResult:
        if len(self.results) == frame:
            raise error
        return process(self, sample, is_held_out)

    monkeypatch.setattr(Slam, "process", processed)


def ended(config: Config, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, Path]:
    """Return the exit code of a run, the one line on stderr, and the folder that `latest` points to."""
    with pytest.raises(SystemExit) as stop:
        launch(lambda: require_tracked(run(config)))
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert message.count("\n") == 1
    assert isinstance(stop.value.code, int)
    return stop.value.code, message, (config.out / "event_replica/tiny/ed_slam/latest").resolve()


def state_of(folder: Path) -> str:
    return json.loads((folder / "run.json").read_text())["state"]


@pytest.mark.parametrize(
    "error", [np.linalg.LinAlgError("Singular matrix"), DataError("broken"), OSError(28, "No space left")]
)
def test_exception_in_the_loop_saves_path_and_map_so_far(
    error: Exception,
    tiny_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    fail_at(6, error, monkeypatch)
    code, message, folder = ended(config_for(tiny_folder, tmp_path), capsys)
    assert code == 1
    assert str(error).split("] ")[-1] in message
    assert state_of(folder) == "failed"
    assert len(read_tum(folder / "trajectory_tum.txt")) == 6
    assert {p.name for p in folder.iterdir()} == ARTEFACTS
    if isinstance(error, np.linalg.LinAlgError):
        assert "fail_at" not in message  # the line is for people, the traceback is in the log
        assert "Traceback" in (folder / "log.txt").read_text()


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_signals_save_what_there_is(
    name: str,
    code: int,
    tiny_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(signal, "getsignal", lambda number: signal.SIG_DFL)  # of a process under nohup, too
    raise_at(4, getattr(signal, name), monkeypatch)
    differences: dict[str, Any] = {"mapping": {"enabled": False}}
    result = ended(config_for(tiny_folder, tmp_path, **differences), capsys)
    assert result[0] == code
    assert state_of(result[2]) == "interrupted"
    assert len(read_tum(result[2] / "trajectory_tum.txt")) == 5


@pytest.mark.parametrize("when", ["loop", "saving"])
def test_second_interrupt_keeps_path_and_map_and_leaves_the_rest(
    when: str,
    tiny_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupted(*arguments: Any, **options: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("a signal breaks this off")

    if when == "saving":
        monkeypatch.setattr(results, "save_views", interrupted)
    else:
        raise_at(5, signal.SIGINT, monkeypatch, times=2)
    code, _, folder = ended(config_for(tiny_folder, tmp_path), capsys)
    assert code == 130
    names = {p.name for p in folder.iterdir()}
    assert {"trajectory_tum.txt", "map.ply", "log.txt", "metrics.json"} <= names
    assert not {"renders", "mesh.ply", "flythrough.mp4"} & names
    assert "left out: views: interrupted" in (folder / "log.txt").read_text()


def raise_at(frame: int, number: int, monkeypatch: pytest.MonkeyPatch, times: int = 1) -> None:
    """Send signals to this process while a frame is processed."""
    process: Callable[..., TrackingResult] = Slam.process

    def processed(self: Slam, sample: Sample, is_held_out: bool = False) -> TrackingResult:
        for _ in range(times if len(self.results) == frame else 0):
            signal.raise_signal(number)
        return process(self, sample, is_held_out)

    monkeypatch.setattr(Slam, "process", processed)


@pytest.mark.parametrize("part", ["plot_trajectory", "save_views", "run_metrics"])
def test_part_that_fails_is_left_out(
    part: str, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any, **options: Any) -> None:
        raise DataError("cannot be measured")

    monkeypatch.setattr(results, part, fail)
    folder = quiet_run(config_for(tiny_folder, tmp_path, duration=0.2))
    assert "cannot be measured" in (folder / "log.txt").read_text()
    made = {
        "plot_trajectory": {"trajectory.png"},
        "save_views": {"renders"},
        "run_metrics": {"metrics.json", "index.html"},  # the page shows the metrics
    }
    assert {p.name for p in folder.iterdir()} == ARTEFACTS - made[part]


def test_full_disk_while_saving_keeps_what_fits(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*arguments: Any, **options: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(results, "write_points", fail)
    code, message, folder = ended(config_for(tiny_folder, tmp_path, duration=0.2), capsys)
    assert (code, state_of(folder)) == (1, "failed")
    assert "No space left on device" in message
    assert {p.name for p in folder.iterdir()} == ARTEFACTS - {"points.ply"}


def test_reader_that_goes_away_does_not_end_the_run(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as closed:
        monkeypatch.setattr(sys, "stdout", closed)
        folder = run(config_for(tiny_folder, tmp_path, duration=0.3, mapping={"enabled": False}))
        assert state_of(folder) == "finished"


def test_more_than_a_tenth_of_lost_frames_is_exit_code_3(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    process: Callable[..., TrackingResult] = Slam.process

    def processed(self: Slam, sample: Sample, is_held_out: bool = False) -> TrackingResult:
        result = process(self, sample, is_held_out)
        if len(self.results) > 12:
            self.results[-1] = replace(self.results[-1], converged=False)
        return result

    monkeypatch.setattr(Slam, "process", processed)
    code, message, folder = ended(config_for(tiny_folder, tmp_path, mapping={"enabled": False}), capsys)
    assert code == 3
    assert "2 of 14 frames were lost" in message
    assert state_of(folder) == "finished"


@pytest.mark.parametrize("name", ["depth/frame000400.png", "images/frame000400.png"])
def test_unreadable_image_in_the_middle_is_a_frame_without_it(
    name: str, recording: Path, tmp_path: Path
) -> None:
    path = recording / name
    path.write_bytes(path.read_bytes()[:300])
    folder = quiet_run(config_for(recording, tmp_path, mapping={"enabled": False}))
    assert len(read_tum(folder / "trajectory_tum.txt")) == 14
    assert path.name in (folder / "log.txt").read_text()
    assert metrics_of(folder)["num_lost_frames"] == 0


def test_many_unreadable_frames_in_a_row_end_the_run(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = SampledSequence.as_far_as_readable

    def damaged(self: SampledSequence, k: int) -> tuple[Sample, str]:
        sample, problem = read(self, k)
        return (replace(sample, depth=None), "damaged") if k > 2 else (sample, problem)

    monkeypatch.setattr(SampledSequence, "as_far_as_readable", damaged)
    with pytest.raises(DataError, match="10 frames in a row cannot be read; the last: damaged"):
        quiet_run(config_for(tiny_folder, tmp_path, mapping={"enabled": False}))
    latest = tmp_path / "event_replica/tiny/ed_slam/latest"
    assert len(read_tum(latest / "trajectory_tum.txt")) == 12
    assert "frame 12 at" in (latest / "log.txt").read_text()


# --- what shows before the first frame ---


def test_missing_lpips_weights_show_before_the_first_frame(tiny_folder: Path, tmp_path: Path) -> None:
    evaluation = {"lpips_weights": str(tmp_path / "missing.pt")}
    with pytest.raises(FileNotFoundError, match="LPIPS weights not found"):
        quiet_run(config_for(tiny_folder, tmp_path / "out", evaluation=evaluation))
    assert not (tmp_path / "out").exists()


def test_place_that_cannot_be_written_shows_before_the_first_frame(
    tiny_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(SystemExit) as stop:
        launch(lambda: print(run(config_for(tiny_folder, tmp_path / "file"))))
    assert stop.value.code == 1
    assert "Not a directory" in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "mine"


def test_unreadable_novel_views_are_left_out_of_evaluation(recording: Path, tmp_path: Path) -> None:
    path = sorted((recording / "novel_views" / "images").iterdir())[1]
    path.write_bytes(path.read_bytes()[:300])
    folder = quiet_run(config_for(recording, tmp_path, duration=0.3))
    assert "left out of evaluation" in (folder / "log.txt").read_text()
    metrics = metrics_of(folder)
    assert metrics["num_novel_views"] == 0
    assert metrics["num_held_out_views"] > 0


def test_latest_that_is_a_folder_stays(tiny_folder: Path, tmp_path: Path) -> None:
    latest = tmp_path / "event_replica/tiny/ed_slam/latest"
    (latest / "mine").mkdir(parents=True)
    folder = quiet_run(config_for(tiny_folder, tmp_path, duration=0.2, mapping={"enabled": False}))
    assert (latest / "mine").is_dir()
    assert state_of(folder) == "finished"


def test_markup_and_control_characters_in_files_are_shown_as_text(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = json.loads((recording / "camera.json").read_text())
    (recording / "camera.json").write_text(json.dumps(camera | {"description": "[/x] [red]\x1b]0;title"}))
    out = tmp_path / "a[red]b"
    run(config_for(recording, out, duration=0.2, mapping={"enabled": False}))
    printed = capsys.readouterr().out
    assert "[/x] [red]\\x1b]0;title" in printed
    assert "a[red]b" in printed.replace("\n", "")
