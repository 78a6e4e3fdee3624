"""A results folder is read back, or refused with the name of what is wrong."""

import contextlib
import json
from pathlib import Path

import pytest
from saved_results import curve, write_result

from edslam_ti.errors import DataError, LostTrackError
from edslam_ti.journal import Journal
from edslam_ti.results.reading import load_result, require_tracked
from edslam_ti.trajectory import Trajectory, write_tum


def test_result_has_a_title_with_its_error(tmp_path: Path) -> None:
    result = load_result(write_result(tmp_path))
    assert result.title == "office0 ed_slam: ATE 0.42 cm rmse"
    assert result.mesh is not None
    assert result.points is not None
    assert len(result.points) == 500


def test_folder_that_is_no_result_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not a results folder"):
        load_result(tmp_path)
    with pytest.raises(FileNotFoundError, match="results folder not found"):
        load_result(tmp_path / "absent")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *[(name, b"garbage") for name in ("points.ply", "mesh.ply", "metrics.json")],
        *[
            ("metrics.json", damage)
            for damage in (b"[" * 100_000, b"[1]", b"\xff", b'{"a": ' + b"9" * 9999 + b"}")
        ],
    ],
)
def test_broken_parts_of_a_result_are_named(tmp_path: Path, name: str, content: bytes) -> None:
    write_tum(curve(), tmp_path / "trajectory_tum.txt")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=name):
        load_result(tmp_path)


def test_run_that_was_cut_off_is_read_from_its_journal(tmp_path: Path) -> None:
    trajectory = curve(10)
    journal, grown = Journal(tmp_path / "journal.csv", 0.0), Trajectory()
    for t, T in zip(trajectory.timestamps, trajectory.poses):
        grown.append(t, T)
        journal.add(grown, True, "")
    (tmp_path / "run.json").write_text('{"state": "running"}')
    result = load_result(tmp_path)
    assert len(result.trajectory) == 10
    assert result.title.endswith("(unfinished)")
    journal.close()


def test_lost_frames_are_told_beyond_a_tenth(tmp_path: Path) -> None:
    for lost, is_told in ((10, False), (11, True)):
        (tmp_path / "metrics.json").write_text(json.dumps({"num_frames": 100, "num_lost_frames": lost}))
        with pytest.raises(LostTrackError) if is_told else contextlib.nullcontext():
            require_tracked(tmp_path)
