"""A journal holds every pose as soon as it is known, and is read whatever moment the process ended at."""

from pathlib import Path

import numpy as np
import pytest
from saved_results import curve

from edslam_ti.errors import DataError
from edslam_ti.journal import Journal, read_journal
from edslam_ti.trajectory import Trajectory


def write(path: Path, trajectory: Trajectory, time_offset: float = 0.0) -> Journal:
    """Write a path pose by pose, as a run does; return the journal, still open."""
    journal, grown = Journal(path, time_offset), Trajectory()
    for t, T in zip(trajectory.timestamps, trajectory.poses):
        grown.append(t, T)
        journal.add(grown, True, "")
    return journal


def test_every_pose_can_be_read_while_the_journal_is_open(tmp_path: Path) -> None:
    journal = write(tmp_path / "journal.csv", curve())
    read = read_journal(tmp_path / "journal.csv")
    np.testing.assert_allclose(read.timestamps, curve().timestamps, atol=1e-9)
    np.testing.assert_allclose(read.poses, curve().poses, atol=1e-8)
    journal.close()


def test_last_line_of_a_frame_counts(tmp_path: Path) -> None:
    trajectory, moved = curve(), np.eye(4)
    moved[:3, 3] = 1, 2, 3
    journal = Journal(tmp_path / "journal.csv", 0.0)
    grown = Trajectory()
    for t, T in zip(trajectory.timestamps, trajectory.poses):
        grown.append(t, T)
        journal.add(grown, True, "")
    grown.replace(4, moved)
    journal.close(grown)
    np.testing.assert_allclose(read_journal(tmp_path / "journal.csv").poses[4], moved, atol=1e-8)


def test_time_stamps_are_on_the_recordings_own_clock(tmp_path: Path) -> None:
    write(tmp_path / "journal.csv", curve(), time_offset=1642650000.00066).close()
    line = (tmp_path / "journal.csv").read_text().splitlines()[2]
    assert line.split(",")[1].startswith("1642650000.05194")  # exact to the nanosecond of float64 seconds


def test_line_that_was_cut_off_does_not_count(tmp_path: Path) -> None:
    path = tmp_path / "journal.csv"
    write(path, curve(10)).close()
    data = path.read_bytes()
    for length in range(len(data) - 60, len(data) - 1):
        path.write_bytes(data[:length])
        assert len(read_journal(path)) == 9, length
    Journal(path, 0.0).close()  # a resumed run goes on in a new line
    assert path.read_bytes().endswith(b"\n")


def test_messages_stay_in_one_line(tmp_path: Path) -> None:
    journal, grown = Journal(tmp_path / "journal.csv", 0.0), Trajectory()
    for k in range(3):
        grown.append(k, np.eye(4))
        journal.add(grown, False, 'two\nlines, a "quote"\x1b[31m')
    journal.close()
    assert len((tmp_path / "journal.csv").read_text().splitlines()) == 4
    assert len(read_journal(tmp_path / "journal.csv")) == 3


def test_full_disk_loses_no_line_that_fits_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from edslam_ti import journal as module

    grown, journal, write = Trajectory(), Journal(tmp_path / "journal.csv", 0.0), module.os.write
    is_full = False

    def limited(file: int, data: bytes) -> int:
        if is_full:
            raise OSError(28, "No space left on device")
        return write(file, data[:7])  # the system may take a part only

    monkeypatch.setattr(module.os, "write", limited)
    for k in range(4):
        is_full = k in (1, 2)
        grown.append(k, np.eye(4))
        journal.add(grown, True, "")
        assert journal.problem == ("No space left on device" if is_full else "")
    journal.close()
    assert len(read_journal(tmp_path / "journal.csv")) == 4


def test_journal_without_a_pose_is_an_error(tmp_path: Path) -> None:
    Journal(tmp_path / "journal.csv", 0.0).close()
    with pytest.raises(DataError, match="no pose in it"):
        read_journal(tmp_path / "journal.csv")
