"""Every method's mapper is all that the rest of the package expects of one."""

from pathlib import Path

import numpy as np
import pytest
from sequences import make_slam, settings

from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.mapping.gaussian_ply import read_gaussian_ply
from edslam_ti.mapping.mapper import Mapper

MEMBERS = [name for name in vars(Mapper) if not name.startswith("_")]


def mapped(sequence: EventDepthSequence, samples: list[Sample], method: str) -> Mapper:
    """Return the mapper of a method after a few frames."""
    few = {"mapping": {"iterations": 1}, "splatam": {"mapping": {"iterations": 1}}}
    slam = make_slam(sequence, samples, settings(method, **few, poses="truth"))
    for sample in samples[:4]:
        slam.process(sample)
    assert slam.mapper is not None
    return slam.mapper


@pytest.mark.parametrize("method", ["ed_slam", "open3d_rgbd", "open3d_icp", "splatam"])
def test_every_mapper_is_complete(
    method: str, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample], tmp_path: Path
) -> None:
    mapper = mapped(tiny_sequence, tiny_samples, method)
    assert {"update", "finish", "render", "points", "metrics", "save", "map"} <= set(MEMBERS)
    assert [name for name in MEMBERS if not hasattr(mapper, name)] == []
    points, brightness = mapper.points()
    assert len(points) == len(brightness) > 100
    assert (mapper.render(tiny_sequence.camera, np.eye(4)).depth >= 0).all()
    assert all(value is None or np.isfinite(value) for value in mapper.metrics().values())
    mapper.save(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == (["map.ply"] if mapper.num_gaussians else [])


def test_gaussian_mapper_lists_its_keyframes_and_saves_its_gaussians(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample], tmp_path: Path
) -> None:
    mapper = mapped(tiny_sequence, tiny_samples, "ed_slam")
    metrics = mapper.metrics()
    assert metrics["num_keyframes"] == len(mapper.keyframe_indices()) >= 1
    assert mapper.keyframe_indices()[0] == 0
    assert metrics["num_hot_pixels"] == 0
    mapper.save(tmp_path)
    saved = read_gaussian_ply(tmp_path / "map.ply")
    assert len(saved["means"]) == mapper.num_gaussians
    np.testing.assert_array_equal(saved["means"], mapper.points()[0])


def test_a_volume_has_no_gaussians_and_no_keyframes(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    mapper = mapped(tiny_sequence, tiny_samples, "open3d_rgbd")
    assert mapper.num_gaussians == 0
    assert np.isnan(mapper.loss)
    assert mapper.keyframe_indices() == []
    assert mapper.metrics() == {}
