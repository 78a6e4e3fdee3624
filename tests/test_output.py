"""Outputs appear whole or not at all."""

import os
import re
import threading
from pathlib import Path

import numpy as np
import pytest

from edslam_ti.errors import DataError
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


def has_old(folder: Path) -> str | None:
    return None if (folder / "old.txt").is_file() else "holds other files"


@pytest.fixture(params=[True, False], ids=["exchange", "two steps"])
def in_one_step(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """With the system's exchange of two names, and as where there is none."""
    if not request.param:
        monkeypatch.setattr("edslam_ti.output._exchange", lambda first, second: False)
    return bool(request.param)


def test_complete_folder_replaces_the_old_one(tmp_path: Path, in_one_step: bool) -> None:
    path = tmp_path / "run"
    path.mkdir()
    (path / "old.txt").write_text("old")
    with atomic_folder(path, has_old) as temporary:
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
        with atomic_folder(path, has_old) as temporary:
            (temporary / "new.txt").write_text("half")
            raise failure

    with pytest.raises(failure):
        write_half()
    assert [p.name for p in path.iterdir()] == ["old.txt"]
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_an_empty_folder_is_filled(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    with atomic_folder(tmp_path / "run") as temporary:
        (temporary / "new.txt").write_text("new")
    assert (tmp_path / "run" / "new.txt").is_file()
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def contents(folder: Path) -> dict[str, str]:
    """Return every file and link below a folder by name."""
    return {
        path.relative_to(folder).as_posix(): os.readlink(path)
        if path.is_symlink()
        else path.read_text()
        if path.is_file()
        else "folder"
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("precious", "precious: holds 'thesis.txt'; expected a new or an empty folder"),
        ("file.txt", "is a file; expected a new or an empty folder; nothing was changed"),
        ("link", "is a link; expected a new or an empty folder; nothing was changed"),
        ("broken link", "is a link"),
        ("precious/..", "expected the name of a new folder"),
        (".", "expected the name of a new folder"),
        ("", "expected the name of a new folder"),
        ("/", "expected the name of a new folder"),
    ],
)
def test_what_is_not_ours_is_refused_and_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.txt").write_text("years")
    (tmp_path / "file.txt").write_text("file")
    (tmp_path / "link").symlink_to("precious")
    (tmp_path / "broken link").symlink_to("nowhere")
    before = contents(tmp_path)
    with pytest.raises(DataError, match=re.escape(message)), atomic_folder(Path(target)):
        pytest.fail("the block was entered")
    assert contents(tmp_path) == before


def test_what_appears_meanwhile_stays(tmp_path: Path, in_one_step: bool) -> None:
    path = tmp_path / "run"
    path.mkdir()
    (path / "old.txt").write_text("old")

    def write() -> None:
        with atomic_folder(path, has_old) as temporary:
            (temporary / "new.txt").write_text("new")
            (path / "old.txt").rename(path / "thesis.txt")

    with pytest.raises(DataError, match="holds other files"):
        write()
    assert contents(tmp_path) == {"run": "folder", "run/thesis.txt": "old"}


def test_what_appears_between_the_last_check_and_the_renaming_stays(
    tmp_path: Path, in_one_step: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run"
    path.mkdir()
    (path / "old.txt").write_text("old")
    answers = iter([None, None])  # at the start and at the end; then the folder holds what came between

    def swapped(folder: Path) -> str | None:
        return next(answers, "holds other files")

    message = "run: holds other files" if in_one_step else "run: another process has just written there"
    with pytest.raises(DataError, match=message), atomic_folder(path, swapped) as temporary:
        (temporary / "new.txt").write_text("new")
    assert contents(tmp_path) == {"run": "folder", "run/old.txt": "old"}


def test_two_new_folders_of_one_name_do_not_mix(tmp_path: Path) -> None:
    path = tmp_path / "run"

    def write() -> None:
        with atomic_folder(path) as first, atomic_folder(path) as second:
            (first / "first.txt").write_text("first")
            (second / "second.txt").write_text("second")

    with pytest.raises(DataError, match=r"holds 'second\.txt'"):
        write()
    assert contents(tmp_path) == {"run": "folder", "run/second.txt": "second"}


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
