"""Compiled kernels are kept in a folder of ours: without a home, read-only, damaged, shared, crashed."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from edslam_ti.kernels.compiled_cache import CompiledKernels, _checksums
from edslam_ti.kernels.engine import ENGINE, ti

pytestmark = pytest.mark.slow  # whole runs, or processes of their own


ROOT = Path(__file__).parents[2]
RUNS_A_KERNEL = """
import numpy as np, sys
from edslam_ti import kernels
kernels.init("cpu", threads=2)
from edslam_ti.kernels.texture import pixel_rays
pixels = np.arange(100, dtype=np.int32)
rays = pixel_rays(np.eye(4), np.array([10.0, 10, 5, 5]), 10, pixels, np.zeros((1, 2), np.float32))
print("sum", rays.sum(), flush=True)
"""


def run(
    environment: dict[str, str | None], code: str = RUNS_A_KERNEL, cwd: Path = ROOT
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], env=changed(environment), capture_output=True, text=True, cwd=cwd
    )


def changed(environment: dict[str, str | None]) -> dict[str, str]:
    # Taichi in debug mode ends itself at a crash, and does not leave it to the signal.
    values = {**os.environ, "PYTHONPATH": str(ROOT), "TI_DEBUG": None, **environment}
    return {name: value for name, value in values.items() if value is not None}


def ran_well(done: subprocess.CompletedProcess[str]) -> bool:
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return "sum 90.0\n" in done.stdout


def kept_files(cache: Path) -> dict[str, bytes]:
    (folder,) = (cache / "kernels").iterdir()
    return {path.name: path.read_bytes() for path in sorted((folder / "compiled").rglob("T*.*"))}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cache = tmp_path_factory.mktemp("cache")
    done = run({"EDSLAM_CACHE": str(cache)})
    assert ran_well(done)
    assert done.stderr == ""
    return cache


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "cache"))


def test_the_second_run_uses_what_the_first_compiled(copy: Path) -> None:
    before = kept_files(copy)
    assert before
    (file,) = (copy / "kernels").rglob("T*.*")
    stamp = file.stat().st_mtime_ns
    done = run({"EDSLAM_CACHE": str(copy)})
    assert ran_well(done)
    assert done.stderr == ""
    assert kept_files(copy) == before
    assert file.stat().st_mtime_ns == stamp
    assert list((copy / "kernels").rglob(".crash*")) == []


def flip(path: Path) -> None:
    data, rng = bytearray(path.read_bytes()), random.Random(path.name)
    for _ in range(5):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)


def make_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def make_link(path: Path) -> None:
    path.unlink()
    path.symlink_to("/etc/passwd")


LOCK = {"taichi": "ticache.lock", "quadrants": "qdcache.lock"}[ENGINE]
DAMAGES: dict[str, Callable[[Path], object]] = {
    "flipped": flip,
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "random": lambda path: path.write_bytes(random.Random(0).randbytes(path.stat().st_size)),
    "folder": make_folder,
    "link": make_link,
    "deleted": Path.unlink,
}


def damage_files(cache: Path, damage: str, which: str) -> None:
    for path in [p for p in (cache / "kernels").rglob("*") if p.is_file() and p.name != "lock"]:
        if which == "*" or path.match(which):
            DAMAGES[damage](path)


@pytest.mark.parametrize("damage", ["flipped", "folder"])
def test_a_damaged_cache_is_made_anew_once(copy: Path, damage: str) -> None:
    damage_files(copy, damage, "*")
    done = run({"EDSLAM_CACHE": str(copy)})
    assert ran_well(done)
    assert "are made anew: they are not as they were written" in done.stderr
    assert done.stderr.count("\n") == 1
    assert len(kept_files(copy)) == 1
    again = run({"EDSLAM_CACHE": str(copy)})
    assert ran_well(again)
    assert again.stderr == ""


@pytest.mark.parametrize("which", ["*", "T*.*", "*cache.*", "checksums.json"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_removed_before_the_engine_reads_them(
    copy: Path, damage: str, which: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("EDSLAM_CACHE", str(copy))
    damage_files(copy, damage, which)
    with CompiledKernels(ti).checked():
        assert kept_files(copy) == {}
    if (damage, which) != ("deleted", "*"):
        assert "are made anew: they are not as they were written" in caplog.text
    caplog.clear()
    with CompiledKernels(ti).checked():
        pass
    assert caplog.text == ""


def test_files_that_nobody_noted_are_removed(copy: Path) -> None:
    (folder,) = (copy / "kernels").iterdir()
    (folder / "compiled" / "Tffff.tic").write_bytes(b"half")
    assert "made anew" in run({"EDSLAM_CACHE": str(copy)}).stderr
    assert "Tffff.tic" not in kept_files(copy)


def test_a_lock_that_a_killed_engine_left_does_not_stop_the_cache(copy: Path) -> None:
    (folder,) = (copy / "kernels").iterdir()
    shutil.rmtree(folder / "compiled")
    (folder / "checksums.json").unlink()
    (folder / "compiled").mkdir()
    (folder / "compiled" / LOCK).write_text("")
    assert ran_well(run({"EDSLAM_CACHE": str(copy)}))
    assert len(kept_files(copy)) == 1


HOMES: dict[str, dict[str, str | None]] = {
    "no HOME": {"HOME": None, "XDG_CACHE_HOME": None},
    "HOME that cannot be made": {"HOME": "/proc/1/nohome", "XDG_CACHE_HOME": None},
    "XDG_CACHE_HOME that cannot be made": {"XDG_CACHE_HOME": "/proc/x"},
    "EDSLAM_CACHE is a file": {"EDSLAM_CACHE": "/etc/hostname"},
    "nothing can be written": {"EDSLAM_CACHE": "/proc/x", "HOME": "/proc/x", "TMPDIR": "/proc/x"},
}


@pytest.mark.parametrize("home", HOMES)
def test_runs_without_a_usable_home(tmp_path: Path, home: str) -> None:
    done = run({"EDSLAM_CACHE": None, **HOMES[home], "TMPDIR": str(tmp_path)})
    assert ran_well(done)
    if HOMES[home].get("HOME", "") not in (None, ""):  # else the home of the user's entry may be usable
        assert "EDSLAM_CACHE=FOLDER keeps it elsewhere" in done.stderr
        assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []  # what had to be temporary is gone


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting needs root")
def test_runs_where_the_cache_is_read_only(made: Path, tmp_path: Path) -> None:
    place = tmp_path / "read_only"
    place.mkdir()
    script = f"mount --bind {made} {place} && mount -o remount,bind,ro {place} && exec {sys.executable} -c"
    done = subprocess.run(
        ["unshare", "-m", "sh", "-c", f'{script} "$0"', RUNS_A_KERNEL],
        env=changed({"EDSLAM_CACHE": str(place), "TMPDIR": str(tmp_path)}),
        capture_output=True,
        text=True,
    )
    if "unshare failed" in done.stderr or "mount:" in done.stderr:
        pytest.skip("mounting is not allowed here")
    assert ran_well(done)
    assert "cannot be written" in done.stderr


CRASHES = (
    RUNS_A_KERNEL
    + """
import os, signal
from ENGINE.lang import kernel_impl
def crash(*args): os.kill(os.getpid(), signal.SIGSEGV)
HOW
"""
)


@pytest.mark.parametrize(
    ("how", "is_remade"),
    [
        # As a kernel of a damaged cache does: the signal comes while the engine's own code is on the stack.
        ("kernel_impl.Kernel.__call__.__globals__['impl'].get_runtime = crash; pixel_rays(np.eye(4), "
         "np.zeros(4), 10, pixels, np.zeros((1, 2), np.float32))", True),
        ("crash()", False),
        ("os.kill(os.getpid(), signal.SIGKILL)", False),
    ],
    ids=["in the engine", "elsewhere", "killed"],
)  # fmt: skip
def test_a_crash_in_the_engine_discards_the_cache(copy: Path, how: str, is_remade: bool) -> None:
    done = run({"EDSLAM_CACHE": str(copy)}, CRASHES.replace("HOW", how).replace("ENGINE", ENGINE))
    assert done.returncode < 0
    again = run({"EDSLAM_CACHE": str(copy)})
    assert ran_well(again)
    assert ("are made anew: a process crashed while it used them" in again.stderr) == is_remade
    assert run({"EDSLAM_CACHE": str(copy)}).stderr == ""


def test_several_processes_share_one_empty_cache(tmp_path: Path) -> None:
    command = [sys.executable, "-c", RUNS_A_KERNEL]
    environment = changed({"EDSLAM_CACHE": str(tmp_path)})
    started = [
        subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) for _ in range(3)
    ]
    for process in started:
        _, errors = process.communicate(timeout=120)
        assert (process.returncode, errors) == (0, "")
    done = run({"EDSLAM_CACHE": str(tmp_path)})
    assert ran_well(done)
    assert done.stderr == ""


def test_a_restart_saves_what_was_compiled(tmp_path: Path) -> None:
    code = RUNS_A_KERNEL + "kernels.init('cpu', precision='f64', threads=2)\n"
    code += "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    assert run({"EDSLAM_CACHE": str(tmp_path)}, code).returncode == -signal.SIGKILL
    assert len(kept_files(tmp_path)) == 1
    assert run({"EDSLAM_CACHE": str(tmp_path)}).stderr == ""


def test_the_check_takes_little_time(tmp_path: Path) -> None:
    for k in range(150):  # as many as all kernels in all their forms
        (tmp_path / f"T{k}.tic").write_bytes(random.Random(k).randbytes(50_000))
    times = []
    for _ in range(5):
        start = time.process_time()
        _checksums(tmp_path)
        times.append(time.process_time() - start)
    assert min(times) < 0.05  # seconds


def test_checksums_name_every_file(made: Path) -> None:
    (folder,) = (made / "kernels").iterdir()
    noted = json.loads((folder / "checksums.json").read_text())
    files = [path for path in (folder / "compiled").rglob("*") if path.is_file()]
    assert sorted(noted) == sorted(path.relative_to(folder / "compiled").as_posix() for path in files)
