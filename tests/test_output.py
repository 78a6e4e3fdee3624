"""Outputs appear whole or not at all."""

import threading
from pathlib import Path

import numpy as np
import pytest

from edslam_ti.output import atomic_file, atomic_folder, write_npy_header


class Interruption(BaseException):
    """Stands for Ctrl-C, which is no Exception."""


def test_file_appears_under_its_name_when_complete(tmp_path: Path) -> None:
    path = tmp_path / "new" / "map.ply"
    with atomic_file(path) as temporary:
        temporary.write_text("whole")
        assert not path.exists()
        assert temporary.suffix == ".ply"  # writers choose the format by the suffix
    assert path.read_text() == "whole"
    assert [p.name for p in path.parent.iterdir()] == ["map.ply"]


@pytest.mark.parametrize("failure", [ValueError, Interruption])
def test_failed_file_leaves_the_old_one_and_nothing_else(
    tmp_path: Path, failure: type[BaseException]
) -> None:
    path = tmp_path / "map.ply"
    path.write_text("old")

    def write_half() -> None:
        with atomic_file(path) as temporary:
            temporary.write_text("half")
            raise failure

    with pytest.raises(failure):
        write_half()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["map.ply"]


def test_folder_appears_under_its_name_when_complete(tmp_path: Path) -> None:
    path = tmp_path / "results" / "run"
    with atomic_folder(path) as temporary:
        (temporary / "metrics.json").write_text("{}")
        assert not path.exists()
    assert (path / "metrics.json").read_text() == "{}"
    assert [p.name for p in path.parent.iterdir()] == ["run"]


def test_complete_folder_replaces_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "run"
    path.mkdir()
    (path / "old.txt").write_text("old")
    with atomic_folder(path) as temporary:
        (temporary / "new.txt").write_text("new")
        assert (path / "old.txt").exists()
    assert [p.name for p in path.iterdir()] == ["new.txt"]
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("failure", [ValueError, Interruption])
def test_failed_folder_leaves_the_old_one_and_nothing_else(
    tmp_path: Path, failure: type[BaseException]
) -> None:
    path = tmp_path / "run"
    path.mkdir()
    (path / "old.txt").write_text("old")

    def write_half() -> None:
        with atomic_folder(path) as temporary:
            (temporary / "new.txt").write_text("half")
            raise failure

    with pytest.raises(failure):
        write_half()
    assert [p.name for p in path.iterdir()] == ["old.txt"]
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_two_writers_of_one_file_do_not_meet(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    barrier = threading.Barrier(2)

    def write(text: str) -> None:
        with atomic_file(path) as temporary:
            temporary.write_text(text)
            barrier.wait(timeout=10)

    threads = [threading.Thread(target=write, args=(text,)) for text in ("a" * 1000, "b" * 1000)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert path.read_text() in ("a" * 1000, "b" * 1000)
    assert len(list(tmp_path.iterdir())) == 1


def test_rows_of_a_npy_file_are_counted_afterwards(tmp_path: Path) -> None:
    dtype = np.dtype("<f4")
    with (tmp_path / "rows.npy").open("wb") as file:
        write_npy_header(file, dtype, 0, 2)
        start = file.tell()
        np.arange(6, dtype=dtype).tofile(file)
        write_npy_header(file, dtype, 3, 2)
        assert file.tell() == start
    np.testing.assert_array_equal(np.load(tmp_path / "rows.npy"), np.arange(6).reshape(3, 2))
