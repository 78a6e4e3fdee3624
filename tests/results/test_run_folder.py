"""A run's folder is its own, and says how far the run is."""

import threading
from pathlib import Path

import pytest

from edslam_ti.errors import DataError
from edslam_ti.results import run_folder
from edslam_ti.results.run_folder import RunFolder, is_unfinished, point_latest_to


def test_runs_of_one_second_get_folders_of_their_own(tmp_path: Path) -> None:
    made: list[RunFolder] = []
    barrier = threading.Barrier(8)

    def make() -> None:
        barrier.wait(timeout=10)
        made.append(RunFolder.make(tmp_path / "a" / "b"))

    threads = [threading.Thread(target=make) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({folder.path for folder in made}) == 8
    made[0].discard()
    assert len(list((tmp_path / "a" / "b").iterdir())) == 7
    for folder in made[1:]:
        folder.discard()
    assert (tmp_path / "a").exists() is False or not list((tmp_path / "a").rglob("20*"))


def test_discarded_folder_leaves_what_was_there_before(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    RunFolder.make(tmp_path / "mine" / "made" / "for it").discard()
    assert [p.name for p in tmp_path.rglob("*")] == ["mine"]


def test_folder_can_be_opened_by_one_process_at_a_time(tmp_path: Path) -> None:
    folder = RunFolder.make(tmp_path)
    folder.write("config.yaml", "seed: 0\n")
    folder.set_state(run_folder.RUNNING)
    with pytest.raises(DataError, match="another process"):
        RunFolder.reopen(folder.path)
    folder.close()
    again = RunFolder.reopen(folder.path)
    assert is_unfinished(again.path)
    again.finish()
    again.close()
    assert not is_unfinished(folder.path)
    assert sorted(p.name for p in folder.path.iterdir()) == ["config.yaml", "run.json"]
    with pytest.raises(DataError, match="has finished"):
        RunFolder.reopen(folder.path)


def test_half_written_files_go_when_a_run_is_resumed(tmp_path: Path) -> None:
    folder = RunFolder.make(tmp_path)
    folder.write("config.yaml", "")
    folder.set_state(run_folder.RUNNING)
    (folder.path / "renders").mkdir()
    for name in (".map.1234abcd.partial.ply", "renders/.contact.1234abcd.partial.png"):
        (folder.path / name).write_text("half")
    folder.close()
    RunFolder.reopen(folder.path).close()
    assert sorted(p.name for p in folder.path.iterdir()) == ["config.yaml", "renders", "run.json"]
    assert list((folder.path / "renders").iterdir()) == []


@pytest.mark.parametrize("content", ["", "{", "[]", "null", "\ud800".encode("utf-8", "surrogatepass")])
def test_folder_that_is_no_runs_is_refused(content: str | bytes, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("")
    data = content if isinstance(content, bytes) else content.encode()
    (tmp_path / "run.json").write_bytes(data)
    with pytest.raises(DataError, match="expected the folder of a run"):
        RunFolder.reopen(tmp_path)
    with pytest.raises(DataError, match="expected the folder of a run"):
        RunFolder.reopen(tmp_path / "absent")
    assert not is_unfinished(tmp_path)


def test_latest_points_to_the_newest(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        assert point_latest_to(tmp_path / name) == ""
        assert (tmp_path / "latest").resolve() == tmp_path / name
    (tmp_path / "latest").unlink()
    (tmp_path / "latest").mkdir()
    assert "is a folder" in point_latest_to(tmp_path / "a")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b", "latest"]
