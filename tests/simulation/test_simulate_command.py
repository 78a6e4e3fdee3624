"""`edslam simulate`: options become a recording that can be read."""

from pathlib import Path

import pytest

from edslam_ti import kernels
from edslam_ti.commands.simulate import main
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import ConfigError

SMALL = ["--width", "48", "--height", "32", "--duration", "0.2", "--samples-per-pixel", "1"]


@pytest.fixture(autouse=True)
def taichi_runs_already(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "init", lambda *arguments, **options: None)


@pytest.mark.slow
def test_a_built_in_scene_is_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["--scene", "wall", "--out", str(tmp_path / "wall"), "--depth-rate", "10", *SMALL])
    sequence = EventReplicaSequence(tmp_path / "wall")
    assert (sequence.camera.width, sequence.camera.height) == (48, 32)
    assert "0.2 s, " in capsys.readouterr().out
    assert len(list((tmp_path / "wall" / "depth").iterdir())) == 3  # at 0, 100 and 200 ms


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "expected either a built-in scene or a mesh"),
        (["--mesh", "a.ply"], "expected a camera path; give --trajectory FILE"),
        (["--scene", "wall", "--width", "2"], "width: Input should be greater than or equal to 8"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, arguments: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        main(["--out", str(tmp_path / "x"), *arguments])
    assert not (tmp_path / "x").exists()
