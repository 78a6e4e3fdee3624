"""The dictionary of formats: what is in it is found, opened and listed, without a line anywhere else."""

from pathlib import Path

import pytest
from written_sequences import write_sequence

from edslam_ti.config import Config
from edslam_ti.datasets import FORMATS, Format, Found, find_sequence, open_sequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import ConfigError


class NotedSequence(EventReplicaSequence):
    """EventReplica's layout with a note in the folder."""

    dataset = "noted"


@pytest.fixture
def noted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fourth format: a folder that holds note.txt, in front of the rest of its files."""
    added = Format(
        "noted layout, with note.txt",
        lambda folder, config: NotedSequence(folder / "files"),
        lambda folder: (folder / "note.txt").is_file(),
    )
    monkeypatch.setitem(FORMATS, "noted", added)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A recording in EventReplica's layout, one in the added format, and the mark of an rpg one."""
    write_sequence(tmp_path / "desk")
    write_sequence(tmp_path / "noted" / "shelf" / "files")
    (tmp_path / "noted" / "shelf" / "note.txt").write_text("a note\n")
    (tmp_path / "slider").mkdir()
    (tmp_path / "slider" / "events.txt").write_text("0.1 1 1 1\n")
    return tmp_path


def settings(data: Path, scene: str, dataset: str | None = None) -> Config:
    return Config(data_dir=data, scene=scene, dataset=dataset)


@pytest.mark.usefixtures("noted")
def test_an_added_format_is_found_and_opened(data: Path) -> None:
    for dataset in (None, "noted"):
        config = settings(data, "shelf", dataset)
        assert find_sequence(config) == Found("noted", data / "noted" / "shelf")
        assert open_sequence(config).dataset == "noted"


@pytest.mark.usefixtures("noted")
@pytest.mark.parametrize(
    ("scene", "dataset", "message"),
    [
        (
            "shef",
            None,
            r"did you mean 'shelf'\?; sequences there: desk, shelf, slider; built-in rooms: room",
        ),
        ("shef", "noted", r"did you mean 'shelf'\?; sequences there: shelf$"),
        ("shelf", "notd", r"dataset: expected one of .*noted, got 'notd'; did you mean 'noted'\?"),
        ("files", None, r"in no known layout; expected one of .*noted \(noted layout, with note\.txt\)"),
    ],
)
def test_an_added_format_is_listed_in_errors(
    data: Path, scene: str, dataset: str | None, message: str
) -> None:
    (data / "files").mkdir()
    with pytest.raises(ConfigError, match=message):
        find_sequence(settings(data, scene, dataset))


@pytest.mark.usefixtures("noted")
def test_a_folder_of_the_added_format_is_detected(data: Path) -> None:
    with pytest.raises(ConfigError, match=r"itself a sequence; use --data-dir .*noted --scene shelf"):
        find_sequence(settings(data / "noted" / "shelf", "desk"))


def test_every_format_is_detected_without_being_named(data: Path) -> None:
    assert find_sequence(settings(data, "desk")) == Found("event_replica", data / "desk")
    assert find_sequence(settings(data, "slider")) == Found("rpg", data / "slider")
    assert find_sequence(settings(data, "office0")) == Found("builtin", None)


def test_a_recording_takes_precedence_over_a_built_in_room(data: Path) -> None:
    write_sequence(data / "event_replica" / "office0")
    assert find_sequence(settings(data, "office0")).dataset == "event_replica"
    assert find_sequence(settings(data, "office0", "builtin")) == Found("builtin", None)


def test_two_layouts_in_one_folder_are_not_guessed(data: Path) -> None:
    (data / "desk" / "events.txt").write_text("0.1 1 1 1\n")
    with pytest.raises(ConfigError, match="desk: looks like event_replica and like rpg; choose one"):
        find_sequence(settings(data, "desk"))
    assert find_sequence(settings(data, "desk", "event_replica")).folder == data / "desk"


def test_opening_prints_nothing(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert open_sequence(settings(data, "desk")).scene == "desk"
    assert capsys.readouterr().out == ""
