"""A run as a file for Rerun, read back with Rerun's own reader."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sequences import make_slam, settings

from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.errors import ConfigError, MissingExtraError
from edslam_ti.viewer import Moment, make_viewers

rerun = pytest.importorskip("rerun", reason="rerun-sdk (extra rerun) is not installed")


def columns(path: Path) -> dict[str, dict[str, list[Any]]]:
    """Return what a file holds: by entity, the values of every column in order of time."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        entity = found.setdefault(chunk.entity_path.strip("/"), {})
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            entity.setdefault(name, []).extend(batch.column(name).to_pylist())
    return found


def column(entity: dict[str, list[Any]], name: str) -> list[Any]:
    return next(values for key, values in entity.items() if name in key)


def test_file_holds_the_run_on_one_time_line(
    tmp_path: Path, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    slam = make_slam(tiny_sequence, tiny_samples, settings("ed_slam", mapping={"iterations": 1}))
    path = tmp_path / "new" / "run.rrd"
    viewer = make_viewers(Config(log=path), lambda line: pytest.fail(line))
    for sample in tiny_samples[:4]:
        slam.process(sample)
        viewer.update(Moment(slam, tiny_sequence.camera, sample, 4, tiny_sequence.truth, 0.25))
    viewer.wait(lambda: False)
    viewer.close()
    held = columns(path)
    names = {
        *("world/camera", "world/camera/image", "world/camera/image/depth", "world/map", "world/path"),
        *("world/truth", "events", "render", "numbers/error_cm", "numbers/loss", "numbers/hertz"),
        *("numbers/gaussians", "numbers/events"),
    }
    assert names <= set(held)
    poses = held["world/camera"]
    translations = np.array(column(poses, "translation")).reshape(-1, 3)
    order = np.argsort(poses["update"])
    np.testing.assert_allclose(translations[order], slam.trajectory.poses[:, :3, 3], atol=1e-6)
    errors = column(held["numbers/error_cm"], "Scalars")
    assert np.ravel(errors).tolist() == [0.25] * 4
    assert sorted(held["numbers/error_cm"]["update"]) == [1, 2, 3, 4]
    last = column(held["world/map"], "positions")[-1]
    assert slam.mapper is not None
    assert len(last) == slam.mapper.num_gaussians
    matrix = column(held["world/camera/image"], "image_from_camera")[0]
    assert np.ravel(matrix)[6:8].tolist() == [tiny_sequence.camera.cx + 0.5, tiny_sequence.camera.cy + 0.5]


def test_what_cannot_be_written_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"expected a file name that ends in .rrd, got 'run.log'"):
        make_viewers(Config(log=Path("run.log")), lambda line: None)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        make_viewers(Config(log=tmp_path / "file" / "run.rrd"), lambda line: None)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'edslam-ti\[rerun\]'"):
        make_viewers(Config(log=tmp_path / "run.rrd"), lambda line: None)
