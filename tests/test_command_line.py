"""The command line: which setting wins, which sequence is opened, and how mistakes end."""

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel
from written_sequences import save_events, some_events, write_sequence

from edslam_ti import __version__, pipeline
from edslam_ti.baselines.kiss import KissIcpTracker
from edslam_ti.camera import Camera
from edslam_ti.command_line import launch, parse_config
from edslam_ti.commands import run
from edslam_ti.config import Config
from edslam_ti.errors import EdSlamError
from edslam_ti.methods import METHODS
from edslam_ti.pipeline import open_recording

ROOT = Path(__file__).parents[1]
APP = ROOT / "apps" / "slam.py"
REPRODUCE = ["tracking", "ablations", "long_stream", "report"]


@pytest.fixture
def configs(tmp_path: Path) -> Path:
    folder = tmp_path / "configs"
    folder.mkdir()
    (folder / "rpg.yaml").write_text("contrast_threshold: 0.3\nseed: 10\nthreads: 10\nmax_interval: 0.5\n")
    return folder


@pytest.fixture
def data(tmp_path: Path) -> Path:
    write_sequence(tmp_path / "data" / "event_replica" / "office0")
    write_sequence(tmp_path / "data" / "my_room")
    return tmp_path / "data"


def open_asked(*arguments: str) -> Any:
    return open_recording(parse_config(arguments))


def failure(capsys: pytest.CaptureFixture[str], act: Callable[[], Any]) -> tuple[int, str]:
    """Return the exit code and what went to stderr, which must be one line."""
    with pytest.raises(SystemExit) as stop:
        launch(act)
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert message.count("\n") == 1
    assert isinstance(stop.value.code, int)
    return stop.value.code, message


def test_no_arguments_give_the_defaults() -> None:
    assert parse_config(["--dataset", "builtin"]) == Config(dataset="builtin")


def test_flags_win_over_file_over_method_over_dataset_over_defaults(tmp_path: Path, configs: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("seed: 20\nthreads: 20\ntracking: {num_patches: 33}\nmethod: ed_slam_paper\n")
    config = parse_config(["--dataset", "rpg", "--config", str(file), "--seed", "30"], configs)
    assert (config.seed, config.threads, config.contrast_threshold) == (30, 20, 0.3)
    assert config.tracking.num_patches == 33
    preset = METHODS["ed_slam_paper"].overrides
    assert config.tracking.depth_weight == preset["tracking"]["depth_weight"]
    # A flag that repeats a default still wins.
    default = parse_config(
        ["--dataset", "rpg", "--config", str(file), "--seed", "0", "--method", "ed_slam"], configs
    )
    assert (default.seed, default.method) == (0, "ed_slam")
    assert default.tracking.depth_weight == Config().tracking.depth_weight


def test_every_field_is_a_flag() -> None:
    """Each leaf's own default, written as a flag, is accepted and changes nothing."""

    def flags(settings: BaseModel, prefix: str = "--") -> list[str]:
        result: list[str] = []
        for name in type(settings).model_fields:
            value, flag = getattr(settings, name), prefix + name.replace("_", "-")
            if isinstance(value, BaseModel):
                result += flags(value, flag + ".")
            else:
                values = value if isinstance(value, tuple) else [value]
                result += [flag, *(str(v).lower() if isinstance(v, bool) else str(v) for v in values)]
        return result

    config = Config(dataset="builtin")
    assert parse_config(flags(config)) == config


def test_nested_switches_take_true_and_false() -> None:
    assert not parse_config(["--dataset", "builtin", "--mapping.enabled", "false"]).mapping.enabled
    assert parse_config(["--dataset", "builtin", "--mapping.enabled=True"]).mapping.enabled
    assert parse_config(["--dataset", "builtin", "--out", "x/y"]).out == Path("x/y")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ("--sceen room0", 2, "unknown option '--sceen'; did you mean '--scene'?"),
        ("--enabled false", 2, "unknown option '--enabled'; did you mean '--mapping.enabled'?"),
        ("office0", 2, "unexpected argument 'office0'"),
        ("--scene", 2, "--scene"),
        ("--seed one", 2, "--seed"),
        ("--mapping.enabled maybe", 2, "expected true or false, got 'maybe'"),
        ("--device tpu", 2, "'tpu'"),
        ("--poses truht", 2, "--poses: expected one of tracked, truth, got 'truht'; did you mean 'truth'?"),
        ("--dataset rpg --tracking.num-patches -3", 1, "tracking.num_patches: Input should be greater"),
        ("--dataset rpg --start nan", 1, "start: "),
        ("--dataset rpg --method ed_slm", 1, "method: expected one of"),
        ("--config /none.yaml", 1, "/none.yaml: settings file not found"),
    ],
)
def test_mistakes_end_in_one_line(
    capsys: pytest.CaptureFixture[str], arguments: str, code: int, message: str
) -> None:
    got = failure(capsys, lambda: parse_config(arguments.split()))
    assert got[0] == code
    assert message in got[1]


def test_event_replica_is_used_where_it_is_found_and_said(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence = open_asked("--scene", "office0", "--data-dir", str(data))
    assert (sequence.dataset, sequence.scene) == ("event_replica", "office0")
    assert f"the recording in {data}/event_replica/office0" in capsys.readouterr().out
    assert open_asked("--scene", "my_room", "--data-dir", str(data)).scene == "my_room"


def test_built_in_room_stands_in_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "edslam_ti.datasets.builtin.builtin_sequence_folder",
        lambda scene, settings: write_sequence(tmp_path / scene),
    )
    sequence = open_asked("--scene", "room2", "--data-dir", str(tmp_path / "nowhere"))
    assert (sequence.dataset, sequence.scene) == ("builtin", "room2")
    assert "built-in stand-in" in capsys.readouterr().out
    assert "stand-in" in sequence.description


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            "--scene my_rom",
            "did you mean 'my_room'?; sequences there: my_room, office0; built-in rooms: room0",
        ),
        ("--scene room9 --dataset builtin", "no built-in room 'room9'; there are room0, room2"),
        ("--scene my_room --dataset rpg", "images.txt not found"),
        ("--scene none --dataset event_replica", "sequences there: my_room, office0"),
    ],
)
def test_unknown_scenes_list_the_existing_ones(
    data: Path, capsys: pytest.CaptureFixture[str], arguments: str, message: str
) -> None:
    (data / "my_room" / "calib.txt").write_text("30 30 16 12 0 0 0 0 0\n")
    got = failure(capsys, lambda: open_asked("--data-dir", str(data), *arguments.split()))
    assert got[0] == 1
    assert message in got[1]


def test_a_sequence_given_as_the_data_folder_is_detected(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, message = failure(capsys, lambda: open_asked("--data-dir", str(data / "my_room"), "--scene", "x"))
    assert code == 1
    assert f"use --data-dir {data} --scene my_room" in message


def test_ctrl_c_and_missing_files_end_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    assert failure(capsys, interrupted) == (130, "error: interrupted\n")
    code, message = failure(capsys, lambda: Path("/none/file.txt").read_text())
    assert (code, message) == (1, "error: /none/file.txt: No such file or directory\n")


def test_defects_keep_their_traceback() -> None:
    def defect() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        launch(defect)


def _run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=120)


def test_help_shows_every_stage_without_loading_torch() -> None:
    result = _run("-X", "importtime", str(APP), "--help")
    assert result.returncode == 0
    for name in Config.model_fields:
        assert f"--{name.replace('_', '-')}" in result.stdout
    assert result.stdout.count("--config FILE") == 1
    for heavy in ("torch", "taichi", "open3d", "matplotlib"):
        assert not re.search(rf"\|\s+{heavy}$", result.stderr, re.MULTILINE)


def test_every_command_has_help_without_loading_torch() -> None:
    code = f"""
import contextlib, sys
from edslam_ti import commands
helps = [[name, "--help"] for name in commands.COMMANDS] + [["reproduce", c, "--help"] for c in {REPRODUCE}]
for arguments in [[], ["--version"], *helps]:
    with contextlib.suppress(SystemExit):
        commands.run(arguments)
print("loaded:", *sys.modules)
"""
    shown, _, loaded = _run("-c", code).stdout.partition("loaded:")
    for name in ("slam", "view", "evaluate", "simulate", "benchmark"):
        assert f"usage: edslam {name} [-h] " in shown
    for name in REPRODUCE:
        assert f"usage: edslam reproduce {name} [-h] [OPTIONS]" in shown
    assert f"edslam {__version__}" in shown.splitlines()
    assert not {"torch", "taichi", "open3d", "matplotlib"} & set(loaded.split())
    assert "edslam_ti.commands.simulate" in loaded.split()


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        *("slam --dataset builtin", "simulate --scene office0 --out x", "benchmark --suites slam"),
        *(f"reproduce {name}" for name in REPRODUCE),
    ],
)
def test_kernels_are_loaded_before_numpy_and_torch(arguments: str) -> None:
    code = f"""
import sys
from edslam_ti import cold_start
def load_kernels():
    sys.exit(bool({{"numpy", "torch"}} & set(sys.modules)))  # they read the environment once
cold_start.load_kernels = load_kernels
from edslam_ti import commands
commands.run({arguments.split()})
"""
    result = _run("-c", code)
    assert (result.returncode, result.stderr) == (0, "")


def test_unknown_commands_are_refused_with_the_nearest_name(capsys: pytest.CaptureFixture[str]) -> None:
    code, message = failure(capsys, lambda: run(["slm"]))
    assert code == 2
    assert "got 'slm'; did you mean 'slam'?" in message


def test_a_run_on_cuda_is_refused_before_anything_loads() -> None:
    code = """
import sys
from edslam_ti import commands
sys.argv = ["edslam", "slam", "--device", "cuda"]
try:
    commands.main()
finally:
    print(*sys.modules)
"""
    result = _run("-c", code)
    assert result.returncode == 1
    assert result.stderr.count("\n") == 1
    assert "not right on cuda yet" in result.stderr
    assert not {"torch", "taichi"} & set(result.stdout.split())
    with pytest.raises(EdSlamError, match="not right on cuda yet"):
        pipeline.run(Config(device="cuda"))


def test_a_method_without_its_package_ends_in_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp.config", None)  # as if it were not installed
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0)
    code, message = failure(capsys, lambda: KissIcpTracker(camera))
    assert code == 1
    assert "pip install 'edslam-ti[kiss]'" in message


@pytest.mark.slow
def test_bad_events_end_the_app_in_one_line_and_leave_no_results(data: Path, tmp_path: Path) -> None:
    events = some_events()
    events[2000::4, 0] = 99  # more than a percent: not a few rows to be left out
    save_events(data / "my_room", events)
    out = tmp_path / "results"
    result = _run(str(APP), "--scene", "my_room", "--data-dir", str(data), "--out", str(out))
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert result.stderr.count("error: ") == 1
    assert "row 2000: expected x in 0 to 31" in result.stderr
    assert not out.exists() or not [p for p in out.rglob("*") if p.is_file()]


@pytest.mark.slow
def test_evaluate_prints_the_errors_of_two_files(tmp_path: Path) -> None:
    times = np.arange(10) * 0.1
    angles = times[:, None] * [1.0, 2.0, 3.0]
    lines = [f"{t} {np.sin(a)} {np.cos(b)} {c} 0 0 0 1\n" for t, (a, b, c) in zip(times, angles)]
    (tmp_path / "a.txt").write_text("".join(lines))
    result = _run(str(ROOT / "apps" / "evaluate.py"), str(tmp_path / "a.txt"), str(tmp_path / "a.txt"))
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("rmse\t0.000000") == 4
    missing = _run(str(ROOT / "apps" / "evaluate.py"), "none.txt", str(tmp_path / "a.txt"))
    assert (missing.returncode, missing.stderr) == (1, "error: none.txt not found\n")


def test_a_bare_switch_is_true() -> None:
    assert parse_config(["--visualize"]).visualize
    config = parse_config(["--visualize", "--mapping.enabled", "false", "--scene", "room0"])
    assert config.visualize
    assert not config.mapping.enabled


def test_ctrl_c_while_the_libraries_end_is_ignored() -> None:
    code = (
        "import atexit, os, signal\n"
        "atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))\n"
        "from edslam_ti.command_line import launch\n"
        "launch(lambda: None)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_current_folder_that_is_gone_is_said(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    code = f"import os; os.rmdir({str(gone)!r}); from edslam_ti.command_line import launch; launch(print)"
    done = subprocess.run([sys.executable, "-c", code], cwd=gone, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("error: the current folder no longer exists")
