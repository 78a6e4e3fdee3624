"""What `simulate` refuses, what it replaces, and what an interrupted one leaves."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from edslam_ti.errors import ConfigError, DataError, EdSlamError
from edslam_ti.simulation.command import Placement, record
from edslam_ti.simulation.recording import why_not_a_recording
from edslam_ti.simulation.settings import SimulationConfig

ROOT = Path(__file__).parents[2]
SMALL = SimulationConfig(width=32, height=24, duration=0.2, samples_per_pixel=1)


def simulate_wall(out: Path, config: SimulationConfig = SMALL, threads: int = 2) -> None:
    record("wall", None, 1.0, None, Placement(), config, out, threads)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.slow
def test_an_older_recording_is_replaced(tmp_path: Path) -> None:
    out = tmp_path / "wall"
    simulate_wall(out)
    first = contents(out)
    assert why_not_a_recording(out) is None
    simulate_wall(out, SMALL.model_copy(update={"seed": 1}))
    assert why_not_a_recording(out) is None
    assert contents(out) != first
    assert [path.name for path in tmp_path.iterdir()] == ["wall"]


@pytest.mark.parametrize("name", ["thesis.txt", "images/photo.jpg", "images/sub/frame000000.png", "notes/x"])
def test_a_recording_with_a_file_of_the_users_is_kept(tiny_folder: Path, tmp_path: Path, name: str) -> None:
    import shutil

    out = Path(shutil.copytree(tiny_folder, tmp_path / "out"))
    (out / name).parent.mkdir(exist_ok=True)
    (out / name).write_text("years of work")
    before = contents(out)
    with pytest.raises(DataError, match=rf"out: holds '{name}' beside a simulated recording; expected a new"):
        simulate_wall(out)
    assert contents(out) == before


@pytest.mark.parametrize(
    "files", [{"README.txt": "My project"}, {"thesis.txt": "x"}, {"camera.json": "{}", "images/a.png": "x"}]
)
def test_a_folder_that_is_no_recording_is_kept(tmp_path: Path, files: dict[str, str]) -> None:
    out = tmp_path / "precious"
    for name, text in files.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(text)
    before = contents(tmp_path)
    with pytest.raises(DataError, match="holds something else than a simulated recording; expected a new"):
        simulate_wall(out)
    assert contents(tmp_path) == before


def test_links_files_and_nameless_folders_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiny_folder: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("file")
    (tmp_path / "link").symlink_to(tiny_folder)
    before = contents(tiny_folder)
    for name in ("file", "link", "link/", ".", "..", "/", "", "link/.."):
        with pytest.raises(DataError, match="nothing was"):
            simulate_wall(Path(name))
    assert contents(tiny_folder) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "link"]


def app(out: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, str(ROOT / "apps" / "simulate.py"), "--scene", "wall", "--out", str(out)]
    size = ["--width", "64", "--height", "48", "--duration", "60", "--samples-per-pixel", "1"]
    return subprocess.Popen([*command, *size, *options], stderr=subprocess.PIPE, text=True, cwd=ROOT)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_an_interrupted_simulation_leaves_the_old_recording(tmp_path: Path, number: signal.Signals) -> None:
    out = tmp_path / "wall"
    simulate_wall(out)
    before = contents(out)
    process = app(out)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob(".wall.*/images/*.png")) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert process.poll() is None
    process.send_signal(number)
    assert process.wait(30) != 0
    assert contents(out) == before
    simulate_wall(out)  # removes what the killed one left
    assert [path.name for path in tmp_path.iterdir()] == ["wall"]


@pytest.mark.parametrize(
    ("placement", "message"),
    [
        (dict(scale=np.nan), "trajectory_scale: Input should be a finite number, got nan"),
        (dict(scale=1e30), "trajectory_scale: Input should be less than or equal to 1e\\+06, got 1e\\+30"),
        (dict(scale=1e-30), "trajectory_scale: Input should be greater than or equal to 1e-06, got 1e-30"),
        (dict(scale=-1.0), "trajectory_scale"),
        (dict(start=np.nan), "trajectory_start"),
        (dict(start=-5.0), "trajectory_start"),
        (dict(position=(np.nan, 0.0, 0.0), target=(1.0, 0.0, 0.0)), "position: Input should be a finite"),
        (dict(position=(0.0, 0.0, 0.0), target=(np.inf, 0.0, 0.0)), "look_at: Input should be a finite"),
        (dict(position=(1e30, 0.0, 0.0), target=(1.0, 0.0, 0.0)), "position: Input should be less"),
    ],
)
def test_placement_that_cannot_be_is_refused(placement: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Placement(**placement)


@pytest.mark.parametrize("threads", [0, -1, 257, 10**12])
def test_threads_have_bounds(tmp_path: Path, threads: int) -> None:
    with pytest.raises(ConfigError, match=r"threads: Input should be .* than or equal to (1|256), got"):
        simulate_wall(tmp_path / "out", threads=threads)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("scale", [np.nan, np.inf, 0.0, -1.0, 1e300, 1e-30])
def test_mesh_scale_has_bounds(tmp_path: Path, scale: float) -> None:
    with pytest.raises(ConfigError, match="mesh_scale: Input should be"):
        record(None, tmp_path / "m.ply", scale, tmp_path / "t.txt", Placement(), SMALL, tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("min_frame_rate", v) for v in (np.inf, np.nan, 1e9, 1e-9)),
        *(("duration", v) for v in (np.inf, np.nan, 1e9, 0.0)),
        *(("focal_length", v) for v in (np.inf, 1e-9)),
        *(("max_motion", v) for v in (np.nan, 1e-9)),
        *(("depth_rate", v) for v in (np.nan, 1e-300)),
        *(("threshold_noise", v) for v in (np.inf, 1e9)),
        ("log_epsilon", 1e-300),
        ("event_gap", (np.nan, np.nan)),
        ("depth_gap", (-1.0, 1.0)),
        ("seed", 2**40),
        ("width", 10**9),
        ("path", "x" * 10**6),
    ],
)
def test_settings_have_bounds(name: str, value: object) -> None:
    with pytest.raises(ConfigError, match=rf"^{name}(\.\d)?: Input should be") as caught:
        SimulationConfig(**{name: value})
    assert len(str(caught.value)) < 300


@pytest.mark.slow
def test_a_recording_without_events_says_why(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no event fired; brightness changes by less than the contrast"):
        simulate_wall(tmp_path / "out", SMALL.model_copy(update={"contrast_threshold": 9.0}))
    away = tmp_path / "away.txt"
    away.write_text("".join(f"{t} {1e4 + t} 0 0 0 0 0 1\n" for t in np.linspace(0, 1, 11)))
    with pytest.raises(DataError, match="the camera sees no surface; check where it is put"):
        record("wall", None, 1.0, away, Placement(), SMALL, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["away.txt"]


@pytest.mark.slow
def test_names_of_scenes_are_printed_without_control_characters(tmp_path: Path) -> None:
    process = app(tmp_path / "out", "--scene", "wa\x1b]0;title\x07ll[red]")
    _, text = process.communicate(timeout=60)
    assert process.returncode == 1
    assert text.startswith(r"error: scene 'wa\x1b]0;title\x07ll[red]': no such built-in scene")
    assert text.count("\n") == 1


@pytest.mark.slow
def test_far_trajectory_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "far.txt"
    path.write_text("0 0 0 0 0 0 0 1\n1 1e3 0 0 0 0 0 1\n")
    with pytest.raises(EdSlamError, match="m away; check its scale"):
        record("wall", None, 1.0, path, Placement(scale=1e5), SMALL, tmp_path / "out")
