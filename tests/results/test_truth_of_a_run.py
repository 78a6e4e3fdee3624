"""Truth with holes, in other conventions, on other clocks: what a run says of it, and what it writes."""

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from sequences import settings

from edslam_ti import pipeline
from edslam_ti.errors import LONGEST_MESSAGE, DataError
from edslam_ti.pipeline import run
from edslam_ti.results import folder as results
from edslam_ti.results import views
from edslam_ti.results.reading import load_result
from edslam_ti.trajectory import read_tum

pytestmark = pytest.mark.slow  # whole runs, or processes of their own


@pytest.fixture(autouse=True)
def taichi_is_started_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline.kernels, "init", lambda *arguments, **options: None)


@pytest.fixture
def recording(tiny_folder: Path, tmp_path: Path) -> Path:
    """A copy of the recording to be changed."""
    return Path(shutil.copytree(tiny_folder, tmp_path / "data" / "changed"))


def change_truth(recording: Path, change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, Any]]) -> None:
    times = np.loadtxt(recording / "poses_ts.txt")
    poses = np.loadtxt(recording / "traj.txt").reshape(-1, 4, 4)
    times, poses = change(times, poses)
    np.savetxt(recording / "poses_ts.txt", times, fmt="%.9f")
    np.savetxt(recording / "traj.txt", np.reshape(poses, (len(times), 16)), fmt="%.12g")


def with_hole(times: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    keep = (times < 0.22) | (times > 0.48)
    return times[keep], poses[keep]


def saved(recording: Path, out: Path, tracking_only: bool = True, **differences: Any) -> tuple[Path, str]:
    """Run a recording; return the results folder and what was printed."""
    mapping = {"iterations": 1, "final_iterations": 4, "enabled": not tracking_only}
    places = {"scene": recording.name, "dataset": "event_replica", "data_dir": recording.parent, "out": out}
    printed = io.StringIO()
    config = settings("ed_slam", **places, mapping=mapping, **differences)
    return run(config, Console(file=printed, width=300)), printed.getvalue()


def metrics_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "metrics.json").read_text())


def test_summary_and_metrics_have_both_alignments_the_scale_and_the_coverage(
    tiny_folder: Path, tmp_path: Path
) -> None:
    folder, printed = saved(tiny_folder, tmp_path)
    metrics = metrics_of(folder)
    assert metrics["truth_notes"] == []
    assert metrics["num_truth_poses_compared"] == metrics["num_frames"] == 14
    assert metrics["truth_coverage"] == 1
    assert metrics["time_offset_s"] == 0
    assert metrics["ate_scale_sim3"] == pytest.approx(1, abs=0.01)
    first = next(line for line in printed.splitlines() if line.startswith("ATE"))
    assert "cm (Sim(3) 0." in first
    assert f"scale {metrics['ate_scale_sim3']:.4f})" in first
    assert "14 compared with truth (100 %)" in printed


def test_errors_are_counted_where_truth_exists(tiny_folder: Path, recording: Path, tmp_path: Path) -> None:
    whole = metrics_of(saved(tiny_folder, tmp_path / "whole")[0])
    change_truth(recording, with_hole)
    folder, printed = saved(recording, tmp_path / "out")
    metrics = metrics_of(folder)
    truth = read_tum(folder / "truth_tum.txt").timestamps
    assert not ((truth > 0.21) & (truth < 0.49)).any()
    assert metrics["num_truth_poses_compared"] == len(truth) < 14
    assert metrics["truth_coverage"] == pytest.approx(len(truth) / 14, abs=1e-4)
    assert metrics["ate_rmse_cm"] < 1.5 * whole["ate_rmse_cm"]
    assert metrics["ate_frontend_rmse_cm"] < 1.5 * whole["ate_frontend_rmse_cm"]
    assert "truth is missing for" in metrics["truth_notes"][0]
    assert metrics["truth_notes"][0] in printed
    assert metrics["truth_notes"][0] in (folder / "log.txt").read_text()


def test_true_poses_are_not_invented_in_a_hole(recording: Path, tmp_path: Path) -> None:
    change_truth(recording, with_hole)
    folder, _ = saved(recording, tmp_path / "out", tracking_only=False, poses="truth")
    metrics = metrics_of(folder)
    assert metrics["num_lost_frames"] == 14 - metrics["num_truth_poses_compared"] > 0
    assert "lost: no true pose at this time" in (folder / "log.txt").read_text()
    assert metrics["ate_rmse_cm"] == 0
    assert metrics["mesh_accuracy_cm"] > 0


def test_inverted_truth_is_named_and_the_run_is_saved(recording: Path, tmp_path: Path) -> None:
    shutil.rmtree(recording / "novel_views")
    change_truth(recording, lambda times, poses: (times, np.linalg.inv(poses)))
    folder, printed = saved(recording, tmp_path / "out", tracking_only=False)
    metrics = metrics_of(folder)
    assert any("poses look inverted" in line for line in metrics["truth_notes"])
    assert "poses look inverted" in printed
    assert metrics["psnr_corrected_db"] > 10
    assert (folder / "mesh.ply").is_file()


def test_part_of_the_evaluation_that_fails_is_left_out(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any, **options: Any) -> None:
        raise DataError("no such\nthing " + 1000 * "x")

    monkeypatch.setattr(results, "plot_trajectory", fail)
    monkeypatch.setattr(results, "write_video", fail)
    monkeypatch.setattr(results, "write_mesh", fail)
    monkeypatch.setattr(views, "_novel_views", fail)
    folder, printed = saved(tiny_folder, tmp_path, tracking_only=False)
    names = {path.name for path in folder.iterdir()}
    assert names >= {
        "trajectory_tum.txt",
        "truth_tum.txt",
        "map.ply",
        "metrics.json",
        "log.txt",
        "config.yaml",
    }
    assert not names & {"trajectory.png", "flythrough.mp4", "mesh.ply"}
    metrics = metrics_of(folder)
    assert metrics["psnr_corrected_db"] > 10
    assert metrics["num_novel_views"] == 0
    for part in ("picture of the path", "fly-through", "mesh", "novel views"):
        [line] = [line for line in printed.splitlines() if line.startswith(f"left out: {part}: ")]
        assert len(line) <= LONGEST_MESSAGE
        assert line[:200] in (folder / "log.txt").read_text()


def test_stamps_since_the_epoch_are_written_unchanged(recording: Path, tmp_path: Path) -> None:
    epoch, events_file = 1642650000, next(recording.glob("event_threshold_*")) / "gray_events_data.npy"
    events = np.load(events_file).astype(np.float64)
    events[:, 2] += epoch
    np.save(events_file, events)
    change_truth(recording, lambda times, poses: (times + epoch, poses))
    shutil.rmtree(recording / "novel_views")
    for name in ("depth", "images"):
        for path in sorted((recording / name).glob("*.png")):
            path.rename(path.with_name(f"frame{int(path.stem[5:]) + 1000 * epoch}.png"))
    folder, _ = saved(recording, tmp_path / "out")
    metrics = metrics_of(folder)
    assert metrics["time_offset_s"] == pytest.approx(epoch, abs=1)
    result = load_result(folder)
    true_stamps = np.loadtxt(recording / "poses_ts.txt")
    for written in (result.trajectory, result.truth, read_tum(folder / "trajectory_frontend_tum.txt")):
        assert written is not None
        apart = np.abs(written.timestamps[:, None] - true_stamps).min(1)
        assert (apart < 1e-6).sum() >= 14  # a frame at every depth image, to the microsecond
