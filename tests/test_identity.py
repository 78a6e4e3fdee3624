"""A run's identity is taken of any folder, without reading what never ends."""

import os
from pathlib import Path

from written_sequences import write_sequence

from edslam_ti.config import Config
from edslam_ti.identity import identity_of


def test_pipes_and_links_to_folders_above_are_not_followed(tmp_path: Path) -> None:
    folder = tmp_path / "data" / "scene"
    write_sequence(folder)
    config = Config(scene="scene", data_dir=tmp_path / "data")
    plain = identity_of(config)["inputs"]
    os.mkfifo(folder / "notes.txt")
    for name in ("above", "itself"):
        (folder / name).symlink_to(folder)
    inputs = identity_of(config)["inputs"]
    assert inputs["poses_ts.txt"] == plain["poses_ts.txt"]
    assert not any("above" in name or "itself" in name for name in inputs)
