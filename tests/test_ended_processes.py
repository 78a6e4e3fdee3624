"""Whole processes of `edslam slam` that are ended from outside: by signals, a closed pipe, a full disk."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from killed_runs import ROOT, folder_in, new_run

from edslam_ti.trajectory import read_tum

pytestmark = pytest.mark.slow
# Signals act as in a terminal, also where these tests run in the background or under nohup.
AS_IN_A_TERMINAL = (
    "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL); "
    "signal.signal(signal.SIGINT, signal.default_int_handler); "
)
PROGRAM = [sys.executable, "-c", f"{AS_IN_A_TERMINAL}from edslam_ti.commands import main; main()", "slam"]


def start(arguments: list[str], stdout: int = subprocess.PIPE) -> "subprocess.Popen[str]":
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [*PROGRAM, *arguments], env=environment, stdout=stdout, stderr=subprocess.PIPE, text=True
    )


def wait_for_lines(out: Path, count: int, process: "subprocess.Popen[str]") -> Path:
    """Wait until a run's journal has so many lines; return its folder."""
    while process.poll() is None:
        folder = folder_in(out)
        journal = None if folder is None else folder / "journal.csv"
        if folder and journal and journal.exists() and journal.read_bytes().count(b"\n") >= count:
            return folder
        time.sleep(0.01)
    raise AssertionError(f"ended early: {process.communicate()}")


@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGHUP", 129), ("SIGINT", 130)])
def test_signal_saves_what_there_is(name: str, code: int, tiny_folder: Path, tmp_path: Path) -> None:
    process = start(new_run(tiny_folder, tmp_path))
    folder = wait_for_lines(tmp_path, 4, process)
    process.send_signal(getattr(signal, name))
    _, errors = process.communicate(timeout=120)
    assert process.returncode == code
    assert errors.count("\n") == 1
    assert len(read_tum(folder / "trajectory_tum.txt")) >= 3
    assert (folder / "map.ply").is_file()


def test_reader_of_the_output_may_go(tiny_folder: Path, tmp_path: Path) -> None:
    process = start(new_run(tiny_folder, tmp_path))
    assert process.stdout is not None
    process.stdout.readline()
    process.stdout.close()  # as `| head -1` does
    assert process.stderr is not None
    errors = process.stderr.read()
    assert (process.wait(timeout=120), errors) == (0, "")
    folder = folder_in(tmp_path)
    assert folder is not None
    assert "finished" in (folder / "run.json").read_text()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 300 kB."""
    place = tmp_path / "small"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(place)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("a small file system can be mounted by root only")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_full_disk_leaves_the_path(small_disk: Path, tiny_folder: Path) -> None:
    process = start(new_run(tiny_folder, small_disk))
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 1
    assert errors.count("\n") == 1
    assert "No space left on device" in errors
    folder = folder_in(small_disk)
    assert folder is not None
    assert len(read_tum(folder / "trajectory_tum.txt")) == 14
