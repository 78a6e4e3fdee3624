"""Generalised ICP of depth: a known motion, frames without depth, a missing package, its state."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from sequences import ate_cm, make_slam, settings, tracked

from edslam_ti.baselines.gicp import SmallGicpTracker
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.errors import MissingExtraError
from edslam_ti.frame import FrameBuilder
from edslam_ti.object_graph import from_graph, outside_of, to_graph
from edslam_ti.rgbd_config import SmallGicpConfig
from edslam_ti.trajectory import Trajectory


def test_motion_in_a_room_is_followed(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> None:
    slam = tracked(tiny_sequence, tiny_samples[:8], settings("small_gicp"))
    assert all(result.converged for result in slam.results)
    assert ate_cm(slam, tiny_sequence) < 0.1  # a pixel is 3 cm wide at 2 m; 0.02 cm is usual


def test_frame_without_depth_is_predicted_and_says_so(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    slam = make_slam(tiny_sequence, tiny_samples, settings("small_gicp", mapping={"enabled": False}))
    nothing = np.zeros(tiny_sequence.camera.shape, np.float32)
    for sample, why in (
        (tiny_samples[0], ""),
        (replace(tiny_samples[1], depth=None), "no depth image"),
        (replace(tiny_samples[2], depth=nothing), "depth at only 0 pixels"),
    ):
        result = slam.process(sample)
        assert result.converged == (why == "")
        assert why in result.message
    assert slam.process(tiny_samples[3]).converged


def test_scene_that_has_nothing_in_common_is_lost(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    slam = make_slam(tiny_sequence, tiny_samples, settings("small_gicp", mapping={"enabled": False}))
    slam.process(tiny_samples[0])
    result = slam.process(replace(tiny_samples[1], depth=tiny_samples[1].depth + np.float32(1.5)))
    assert not result.converged
    assert "found a partner" in result.message


def test_tracker_goes_on_from_its_state(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    frames = [FrameBuilder(tiny_sequence.camera).build(sample) for sample in tiny_samples[:3]]
    tracker = SmallGicpTracker(tiny_sequence.camera, SmallGicpConfig())
    outside = outside_of(tracker, lambda value: isinstance(value, SmallGicpConfig))
    for frame in frames[:2]:
        tracker.track(frame, np.eye(4), Trajectory())
    again = from_graph(to_graph(tracker, outside), outside)
    one, other = (t.track(frames[2], np.eye(4), Trajectory()) for t in (tracker, again))
    np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)


def test_missing_package_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tiny_sequence: EventDepthSequence
) -> None:
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(MissingExtraError, match=r"small_gicp needs pip install 'edslam-ti\[gicp\]'$"):
        SmallGicpTracker(tiny_sequence.camera, SmallGicpConfig())
