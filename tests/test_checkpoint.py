"""A run that was cut off at any moment goes on to the same trajectory and map, to the bit."""

import io
import json
import random
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from killed_runs import differences, finished, folder_in, killed_and_resumed, new_run
from rich.console import Console
from sequences import settings

from edslam_ti import checkpoint, pipeline
from edslam_ti.checkpoint import Checkpoints
from edslam_ti.command_line import UsageError, parse_config, read_choices
from edslam_ti.config import Config
from edslam_ti.datasets import Sample
from edslam_ti.errors import DataError
from edslam_ti.mapping.change_mapper import ChangeMapper
from edslam_ti.mapping.gaussian_mapper import GaussianMapper
from edslam_ti.object_graph import Graph
from edslam_ti.pipeline import resume, run
from edslam_ti.results.run_folder import RunFolder
from edslam_ti.slam import Slam
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.trajectory import read_tum

pytestmark = pytest.mark.slow  # whole runs, or processes of their own


COMPARED = ("trajectory_tum.txt", "trajectory_frontend_tum.txt", "map.ply")
FEW = {"iterations": 1, "final_iterations": 20}


@pytest.fixture(autouse=True)
def taichi_is_started_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline.kernels, "init", lambda *arguments, **options: None)


@pytest.fixture(autouse=True)
def checkpoints_are_as_frequent_as_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "LEAST_PAUSE", 0)


@pytest.fixture
def recording(tiny_folder: Path, tmp_path: Path) -> Path:
    """A copy of the recording to be changed."""
    return Path(shutil.copytree(tiny_folder, tmp_path / "data" / "changed"))


def config_for(recording: Path, out: Path, method: str = "ed_slam", **differences: Any) -> Config:
    places = {"scene": recording.name, "dataset": "event_replica", "data_dir": recording.parent, "out": out}
    mapping = FEW | differences.pop("mapping", {})
    return settings(method, **places, mapping=mapping, **({"checkpoint": 1e-6} | differences))


def quiet() -> Console:
    return Console(file=io.StringIO())


class Cut(BaseException):
    """Stands for kill -9: nothing is saved."""


def cut_off(config: Config, monkeypatch: pytest.MonkeyPatch, frame: int, step: int | None = None) -> Path:
    """Run until a frame, or until a step of the refinement, and return the folder as it was then."""
    process, optimise = Slam.process, GaussianMapper._optimise
    count = 0

    def processed(self: Slam, sample: Sample, is_held_out: bool = False) -> TrackingResult:
        if len(self.results) == frame:
            raise Cut
        return process(self, sample, is_held_out)

    def optimised(self: GaussianMapper, *arguments: Any, **options: Any) -> Any:
        nonlocal count
        count += self._refinement is not None
        if count == step:
            raise Cut
        return optimise(self, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Slam, "process", processed)
        patch.setattr(GaussianMapper, "_optimise", optimised)
        patch.setattr(RunFolder, "discard", lambda self: None)
        with pytest.raises(Cut):
            run(config, quiet())
    return next(p for p in config.out.glob("*/*/*/*") if p.name != "latest")


def same_files(a: Path, b: Path) -> bool:
    return all((a / n).read_bytes() == (b / n).read_bytes() for n in COMPARED if (b / n).exists())


@pytest.fixture(scope="module")
def reference(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline.kernels, "init", lambda *arguments, **options: None)
        return run(config_for(tiny_folder, tmp_path_factory.mktemp("reference"), checkpoint=0.0), quiet())


def test_checkpoints_change_no_result_and_leave_nothing(
    reference: Path, tiny_folder: Path, tmp_path: Path
) -> None:
    folder = run(config_for(tiny_folder, tmp_path), quiet())
    assert same_files(folder, reference)
    assert {p.name for p in folder.iterdir()} == {p.name for p in reference.iterdir()}


@pytest.mark.parametrize(("frame", "step"), [(1, None), (7, None), (99, 5), (99, 19)])
def test_resumed_run_is_the_uninterrupted_one(
    frame: int,
    step: int | None,
    reference: Path,
    tiny_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = config_for(tiny_folder, tmp_path)
    folder = cut_off(config, monkeypatch, frame, step)
    assert len(list((folder / "checkpoint").iterdir())) >= 1
    before = len((folder / "journal.csv").read_text().splitlines())
    console = quiet()
    assert resume(folder, config, console) == folder
    assert same_files(folder, reference)
    assert not (folder / "checkpoint").exists()
    assert len((folder / "journal.csv").read_text().splitlines()) >= before
    where = f"frame {min(frame, 14) + 1} of 14"
    assert f"resumed from {where}" in console.file.getvalue()  # type: ignore[attr-defined]
    assert json.loads((folder / "metrics.json").read_text())["num_frames"] == 14


@pytest.mark.parametrize(
    ("method", "differences"),
    [
        ("ed_slam_paper", {"mapping": {"enabled": False}}),
        ("ed_slam", {"poses": "truth", "mapping": {"densify": True, "densify_every": 3}}),
        ("ed_slam", {"mapping": {"frames": True}}),
    ],
)
def test_other_methods_and_settings_are_resumed_as_well(
    method: str,
    differences: dict[str, Any],
    tiny_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = run(config_for(tiny_folder, tmp_path / "whole", method, **dict(differences)), quiet())
    config = config_for(tiny_folder, tmp_path / "cut", method, **dict(differences))
    is_mapping = config.mapping.enabled
    folder = cut_off(config, monkeypatch, *((99, 8) if is_mapping else (9, None)))
    resume(folder, config, quiet())
    assert same_files(folder, whole)


@pytest.mark.parametrize(
    ("method", "frame"),  # 99: in mid refinement
    [("ed_slam_paper", 99), ("event_3dgs", 99), ("inc_event_gs", 7), ("depth_event_vo", 4)],
)
def test_methods_of_other_papers_are_resumed_as_well(
    method: str, frame: int, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run(config_for(tiny_folder, tmp_path / "whole", method, duration=0.45), quiet())
    config = config_for(tiny_folder, tmp_path / "cut", method, duration=0.45)
    step = ChangeMapper.step

    def stepped(self: ChangeMapper, *arguments: Any, **options: Any) -> float:
        if self._num_final == 8:
            raise Cut
        return step(self, *arguments, **options)

    with monkeypatch.context() as patch:
        if frame == 99:
            patch.setattr(ChangeMapper, "step", stepped)
        folder = cut_off(config, monkeypatch, frame)
    console = quiet()
    resume(folder, config, console)
    assert "resumed from the first frame" not in console.file.getvalue()  # type: ignore[attr-defined]
    assert same_files(folder, whole)


def test_interrupted_run_is_resumed_where_it_was_interrupted(
    reference: Path, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import signal

    process = Slam.process

    def processed(self: Slam, sample: Sample, is_held_out: bool = False) -> TrackingResult:
        if len(self.results) == 6:
            signal.raise_signal(signal.SIGINT)
        return process(self, sample, is_held_out)

    config = config_for(tiny_folder, tmp_path, checkpoint=60.0)
    with monkeypatch.context() as patch:
        patch.setattr(Slam, "process", processed)
        with pytest.raises(KeyboardInterrupt):
            run(config, quiet())
    folder = (tmp_path / "event_replica/tiny/ed_slam/latest").resolve()
    assert len(read_tum(folder / "trajectory_tum.txt")) == 7
    console = quiet()
    resume(folder.parent / "latest", config, console)
    assert "resumed from frame 8 of 14" in console.file.getvalue()  # type: ignore[attr-defined]
    assert same_files(folder, reference)
    assert not json.loads((folder / "metrics.json").read_text())["is_interrupted"]


def test_method_that_cannot_be_kept_begins_with_the_first_frame(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_for(tiny_folder, tmp_path, "open3d_icp", duration=0.3)
    folder = cut_off(config, monkeypatch, 3)
    console = quiet()
    resume(folder, config, console)
    assert "resumed from the first frame" in console.file.getvalue()  # type: ignore[attr-defined]
    assert "no checkpoints" in (folder / "log.txt").read_text()
    assert len(read_tum(folder / "trajectory_tum.txt")) == 6


# --- what cannot be resumed ---


def test_finished_run_is_not_resumed(reference: Path, tiny_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="this run has finished"):
        resume(reference, config_for(tiny_folder, tmp_path), quiet())


def test_two_processes_cannot_be_at_one_run(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_for(tiny_folder, tmp_path)
    folder = cut_off(config, monkeypatch, 2)
    lock = (
        "import fcntl, sys; f = open(sys.argv[1], 'w'); fcntl.flock(f, fcntl.LOCK_EX); print('4321', file=f, "
        "flush=True); print('locked', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", lock, folder / ".lock"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert other.stdout is not None
    other.stdout.readline()
    try:
        with pytest.raises(DataError, match=r"another process \(4321\) is writing this run"):
            resume(folder, config, quiet())
    finally:
        other.communicate()


def test_other_recording_is_refused(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_for(recording, tmp_path / "out")
    folder = cut_off(config, monkeypatch, 2)
    path = sorted((recording / "depth").iterdir())[5]
    path.write_bytes(path.read_bytes())  # the time of its last change is another
    with pytest.raises(DataError, match="depth of the recording has been changed"):
        resume(folder, config, quiet())


def test_other_settings_are_refused(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_for(tiny_folder, tmp_path)
    folder = cut_off(config, monkeypatch, 2)
    with pytest.raises(DataError, match=r"config.yaml has been changed"):
        resume(folder, config.updated({"seed": 5}), quiet())
    assert resume(folder, config.updated({"checkpoint": 0.0}), quiet()) == folder


def test_command_line_takes_the_settings_of_the_run(reference: Path, tmp_path: Path) -> None:
    choices = read_choices(["--resume", str(reference), "--checkpoint", "5"])
    assert choices.resumed == reference
    assert choices.config.mapping.final_iterations == 20
    assert parse_config(["--resume", str(reference)]).scene == "tiny"
    for flag in (["--seed", "1"], ["--mapping.iterations", "2"], ["--config", "x.yaml"], ["--out", "x"]):
        with pytest.raises(UsageError, match="--resume: goes on with the run's own settings"):
            read_choices(["--resume", str(reference), *flag])
    with pytest.raises(DataError, match="expected the folder of a run"):
        resume(tmp_path, Config(), quiet())


# --- files ---


def graph(*arrays: np.ndarray) -> Graph:
    return Graph([0], [["list", [1]]], list(arrays))


def big(value: int) -> np.ndarray:
    return np.full(10_000, value)


def test_arrays_that_stay_are_written_once(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    for k in range(4):
        checkpoints.write(graph(big(0), big(1), big(2), big(10 + k)), {"k": k})
    sizes = {p.name: p.stat().st_size for p in tmp_path.iterdir()}
    assert sizes["000001.state"] > 4 * big(0).nbytes
    assert sizes["000004.state"] < 1.1 * big(0).nbytes
    assert "000002.state" not in sizes  # two checkpoints are kept, and the file that they share
    newest = Checkpoints(tmp_path).newest()
    assert newest is not None
    assert [int(a[0]) for a in newest[0].arrays] == [0, 1, 2, 13]
    assert newest[1] == {"k": 3}


def test_files_that_are_mostly_out_of_date_go(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    for k in range(20):
        checkpoints.write(graph(big(0), *(big(1 + j + k // 5) for j in range(6))), {})
    assert sum(p.stat().st_size for p in tmp_path.iterdir()) < 3 * 7 * big(0).nbytes


@pytest.mark.parametrize("damage", ["cut", "flipped", "missing", "empty"])
def test_damaged_checkpoint_is_passed_over(damage: str, tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    for k in range(2):
        checkpoints.write(graph(big(k), np.arange(3)), {"k": k})
    path = tmp_path / "000002.state"
    data = bytearray(path.read_bytes())
    if damage == "flipped":
        data[1000] ^= 1
    path.write_bytes(data[:-100] if damage == "cut" else b"" if damage == "empty" else data)
    if damage == "missing":
        path.unlink()
    (tmp_path / ".3.partial").write_bytes(b"half")
    newest = Checkpoints(tmp_path).newest()
    assert newest is not None
    assert newest[1] == {"k": 0}
    assert not (tmp_path / ".3.partial").exists()


def test_full_disk_ends_no_run(
    reference: Path, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: Any) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "_appended", full)
    folder = run(config_for(tiny_folder, tmp_path), quiet())
    assert same_files(folder, reference)
    assert "a checkpoint could not be written: No space left" in (folder / "log.txt").read_text()


# --- kill -9 ---


@pytest.mark.timeout(1200)
def test_killed_runs_come_to_the_same_end(tiny_folder: Path, tmp_path: Path, kills: int) -> None:
    finished(new_run(tiny_folder, tmp_path / "reference"))
    whole = folder_in(tmp_path / "reference")
    assert whole is not None
    rng, done, k = random.Random(0), 0, 0
    while done < kills:
        k += 1
        folder, killed = killed_and_resumed(tiny_folder, tmp_path / f"run{k}", rng)
        done += len(killed)
        assert differences(folder, whole) == [], killed
