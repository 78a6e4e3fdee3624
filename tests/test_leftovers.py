"""What killed processes leave half written is removed later; what living ones write stays."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from edslam_ti.leftovers import remove_leftovers, temporary_name
from edslam_ti.output import atomic_file, atomic_folder

WRITES_FOR_EVER = """
import sys, time
from pathlib import Path
from edslam_ti.output import atomic_file, atomic_folder
with atomic_folder(Path(sys.argv[1]) / "run") as folder, atomic_file(Path(sys.argv[1]) / "map.ply") as file:
    (folder / "half").write_text("half")
    file.write_text("half")
    print("writing", flush=True)
    time.sleep(60)
"""


def writer(folder: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", WRITES_FOR_EVER, str(folder)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "writing\n"
    return process


def test_what_a_killed_process_wrote_is_removed_by_the_next_writer(tmp_path: Path) -> None:
    process = writer(tmp_path)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert len(list(tmp_path.iterdir())) == 2
    with atomic_file(tmp_path / "other.txt") as temporary:
        assert list(tmp_path.iterdir()) == []
        temporary.write_text("whole")
    assert [path.name for path in tmp_path.iterdir()] == ["other.txt"]


def test_what_a_running_process_writes_stays(tmp_path: Path) -> None:
    process = writer(tmp_path)
    try:
        before = sorted(tmp_path.iterdir())
        assert remove_leftovers(tmp_path) == []
        with atomic_folder(tmp_path / "other"):
            pass
        assert sorted(tmp_path.iterdir()) == sorted([*before, tmp_path / "other"])
    finally:
        process.kill()
        process.wait()


def dead_process() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.mark.parametrize(
    "name",
    [
        ".run.1a2b3c4d.partial",
        ".run.partial",
        "run.ffffffff-{dead}-1a2b3c4d.partial",
        ".run.ffffffff-{dead}-1a2b3c4d.partial",
        ".run.ffffffff-{dead}-1a2b3c4d.part",
    ],
)
def test_other_names_and_other_hosts_are_left_alone(tmp_path: Path, name: str) -> None:
    path = tmp_path / name.format(dead=dead_process())
    path.mkdir()
    assert remove_leftovers(tmp_path) == []
    assert path.is_dir()


def test_a_folder_that_was_moved_away_gets_its_name_back(tmp_path: Path) -> None:
    old = temporary_name(tmp_path / "run", "old")
    old = old.with_name(old.name.replace(f"-{os.getpid()}-", f"-{dead_process()}-"))
    old.mkdir()
    (old / "data").write_text("data")
    assert remove_leftovers(tmp_path) == []
    assert (tmp_path / "run" / "data").read_text() == "data"
    (tmp_path / "run").rename(old)
    (tmp_path / "run").mkdir()  # the new one came: the old one goes
    assert remove_leftovers(tmp_path) == [old]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_link_is_removed_and_not_followed(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "kept").write_text("kept")
    link = temporary_name(tmp_path / "run")
    link = link.with_name(link.name.replace(f"-{os.getpid()}-", f"-{dead_process()}-"))
    link.symlink_to(tmp_path / "data")
    assert remove_leftovers(tmp_path) == [link]
    assert (tmp_path / "data" / "kept").is_file()


def test_a_long_name_still_gets_a_temporary_one(tmp_path: Path) -> None:
    path = tmp_path / ("ä" * 120 + ".txt")
    with atomic_file(path) as temporary:
        temporary.write_text("whole")
    assert path.read_text() == "whole"
