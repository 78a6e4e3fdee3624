"""SplaTAM's tracking and mapping on the tiny room: path, views, lost frames, state, pruning."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import BaseModel
from sequences import ate_cm, make_slam, settings

from edslam_ti.baselines.splatam.mapper import SplatamMapper
from edslam_ti.baselines.splatam.similarity import SIGMA, WINDOW, Similarity
from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.errors import ConfigError, DataError
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.methods import METHODS
from edslam_ti.object_graph import from_graph, outside_of, to_graph
from edslam_ti.slam import Slam

FEW: dict[str, Any] = {"tracking": {"iterations": 20}, "mapping": {"iterations": 10}}
Started = Callable[..., Slam]


@pytest.fixture
def started(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> Started:
    def make(**differences: Any) -> Slam:
        config = settings("splatam", **({"splatam": FEW} | differences))
        return make_slam(tiny_sequence, tiny_samples, config)

    return make


def mapper_of(slam: Slam) -> SplatamMapper:
    assert isinstance(slam.mapper, SplatamMapper)
    return slam.mapper


def psnr(a: np.ndarray, b: np.ndarray | None) -> float:
    assert b is not None
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def test_path_is_followed_and_views_held_out_are_shown(
    started: Started, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    slam = started(splatam={"mapping": {"iterations": 20, "keyframe_every": 3}})
    for k, sample in enumerate(tiny_samples[:6]):
        assert slam.process(sample, is_held_out=k == 4).converged
    assert ate_cm(slam, tiny_sequence) < 0.8  # of 10 cm, where a pixel is 3 cm wide; 0.45 is usual
    mapper = mapper_of(slam)
    assert mapper.keyframe_indices() == [0, 3]
    view = mapper.render(tiny_sequence.camera, slam.trajectory.pose(4))
    assert psnr(view.intensity, tiny_samples[4].image) > 26  # 28.6 is usual with so few steps
    assert np.median(np.abs(view.depth - tiny_samples[4].depth)) < 0.02
    assert mapper.metrics()["num_mapping_steps"] == 5 * 20


def test_frames_that_cannot_be_tracked_are_predicted_and_not_mapped(
    started: Started, tiny_samples: list[Sample]
) -> None:
    slam = started()
    for sample in tiny_samples[:2]:
        slam.process(sample)
    count, nothing = len(mapper_of(slam).map), np.zeros_like(tiny_samples[2].depth)
    for sample, why in (
        (replace(tiny_samples[2], depth=None), "no depth image at this time: pose predicted"),
        (replace(tiny_samples[2], image=None), "no image at this time"),
        (replace(tiny_samples[2], depth=nothing), "depth at no pixel"),
        (replace(tiny_samples[2], depth=tiny_samples[2].depth + np.float32(2)), "the map explains only"),
    ):
        result = slam.process(replace(sample, timestamp=0.1 + 0.01 * len(slam.results)))
        assert not result.converged
        assert why in result.message
        assert len(mapper_of(slam).map) == count
    assert slam.process(replace(tiny_samples[2], timestamp=0.2)).converged


def test_map_begins_with_the_first_complete_frame(started: Started, tiny_samples: list[Sample]) -> None:
    slam = started()
    results = [slam.process(replace(tiny_samples[0], depth=None)), slam.process(tiny_samples[1])]
    assert [result.converged for result in results] == [False, True]
    assert len(mapper_of(slam).map) > 1000
    assert slam.process(tiny_samples[2]).converged


def test_after_a_sudden_stop_the_last_pose_is_tried_too(
    started: Started, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    slam = started()
    slam.process(tiny_samples[0])
    far = tiny_samples[0].T_world_camera @ np.diag([-1.0, 1.0, -1.0, 1.0])  # looks the other way
    frame = slam.frame_builder.build(tiny_samples[1])
    result = slam.tracker.track(frame, far, slam.trajectory)
    assert result.converged
    assert np.linalg.norm(result.T_world_camera[:3, 3] - tiny_samples[1].T_world_camera[:3, 3]) < 0.05


def test_sparse_depth_is_mapped_at_reduced_size(started: Started, tiny_samples: list[Sample]) -> None:
    width = {"image_width": 60}
    slam = started(splatam={"tracking": FEW["tracking"] | width, "mapping": FEW["mapping"] | width})
    for sample in tiny_samples[:2]:
        lines = np.zeros_like(sample.depth)
        lines[::4] = sample.depth[::4]
        assert slam.process(replace(sample, depth=lines)).converged
    assert len(mapper_of(slam).map) > 500


def test_frame_held_out_changes_nothing_in_the_map(started: Started, tiny_samples: list[Sample]) -> None:
    slam = started()
    slam.process(tiny_samples[0])
    before = {name: value.clone() for name, value in mapper_of(slam).map.raw.items()}
    slam.process(tiny_samples[1], is_held_out=True)
    assert all(torch.equal(value, before[name]) for name, value in mapper_of(slam).map.raw.items())


def test_run_goes_on_from_its_state_to_the_bit(started: Started, tiny_samples: list[Sample]) -> None:
    def is_outside(value: Any) -> bool:
        return isinstance(value, BaseModel | EventDepthSequence)

    slam, fresh = started(), started()
    outside = outside_of(fresh, is_outside)
    for sample in tiny_samples[:3]:
        slam.process(sample)
    again = from_graph(to_graph(slam, outside_of(slam, is_outside)), outside)
    for sample in tiny_samples[3:5]:
        for one in (slam, again):
            one.process(sample)
    np.testing.assert_array_equal(again.trajectory.poses, slam.trajectory.poses)
    for name, value in mapper_of(slam).map.raw.items():
        assert torch.equal(mapper_of(again).map.raw[name], value)
    assert again.tracker._map is mapper_of(again).map  # still one map


def test_faint_and_huge_gaussians_are_removed(started: Started, tiny_samples: list[Sample]) -> None:
    slam = started(splatam={**FEW, "mapping": {"iterations": 0}})
    slam.process(tiny_samples[0])
    mapper = mapper_of(slam)
    count = len(mapper.map)
    mapper.map.raw["logit_opacities"][:10] = -8.0  # an opacity of 0.0003
    mapper.map.raw["log_scales"][10:15] = 1.0  # 2.7 m
    slow = mapper._config.model_copy(update={"iterations": 2, "opacities_rate": 1e-6, "scales_rate": 1e-6})
    mapper._config = slow
    slam.process(tiny_samples[1])
    raw = mapper.map.raw
    assert float(raw["logit_opacities"].min()) > -6
    assert float(raw["log_scales"].max()) < 0
    assert len(mapper.map) >= count - 15


@pytest.mark.parametrize("disc", [False, True])
def test_similarity_is_that_of_a_window_around_each_pixel(disc: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = torch.rand(2, 24, 31, generator=generator)
    b = a + 0.1 * b if disc else b
    taps = torch.exp(-((torch.arange(WINDOW) - WINDOW // 2) ** 2) / (2 * SIGMA**2))
    window = torch.outer(taps, taps)[None, None] / taps.sum() ** 2

    def blurred(image: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(image[None, None], window, padding=WINDOW // 2)[0, 0]

    mean_a, mean_b = blurred(a), blurred(b)
    variance_a, variance_b = blurred(a * a) - mean_a**2, blurred(b * b) - mean_b**2
    covariance = blurred(a * b) - mean_a * mean_b
    expected = (2 * mean_a * mean_b + 1e-4) * (2 * covariance + 9e-4)
    expected = expected / ((mean_a**2 + mean_b**2 + 1e-4) * (variance_a + variance_b + 9e-4))
    similarity = Similarity(24, 31, "cpu")
    torch.testing.assert_close(similarity(a, similarity.target(b)), expected.mean(), atol=1e-5, rtol=0)
    torch.testing.assert_close(similarity(a, similarity.target(a)), torch.tensor(1.0), atol=1e-5, rtol=0)


def test_what_it_lacks_is_said_in_one_line(tiny_sequence: EventDepthSequence) -> None:
    contrast = ContrastThreshold(0.1, "data")
    off = Config(method="splatam").updated({"mapping": {"enabled": False}})
    with pytest.raises(ConfigError, match="splatam tracks by its map"):
        METHODS["splatam"].build(tiny_sequence, contrast, off)

    class Imageless(type(tiny_sequence)):  # type: ignore[misc]
        image_timestamps = np.empty(0)

        def __init__(self) -> None:
            self.scene, self.depth_timestamps = "tiny", np.arange(3.0)

    with pytest.raises(DataError, match="method splatam needs images taken with the depth images"):
        METHODS["splatam"].build(Imageless(), contrast, Config(method="splatam"))
