"""Whether events and depth tell the same motion: right recordings pass, faults are named."""

from dataclasses import replace

import numpy as np
import pytest
from sequences import record_tiny_room, tracked

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, Sample, SampledSequence
from edslam_ti.datasets.altered import AlteredSequence
from edslam_ti.datasets.base import WrappedSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.events import Events
from edslam_ti.inspection.calibration import ShiftedDepth, TurnedDepth, calibrate_depth
from edslam_ti.tracking.consistency import Consistency

pytestmark = pytest.mark.slow  # whole runs, or processes of their own


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> EventDepthSequence:
    """A recording whose motion changes its speed: only that shows a delay."""
    folder = record_tiny_room(tmp_path_factory.mktemp("longer") / "tiny", duration=1.6)
    return EventReplicaSequence(folder)


class OtherFocalLength(WrappedSequence):
    """A sequence that states another focal length than its camera had."""

    def __init__(self, sequence: EventDepthSequence, factor: float) -> None:
        super().__init__(sequence)
        c = sequence.camera
        self.camera = Camera(c.width, c.height, factor * c.fx, factor * c.fy, c.cx, c.cy)


def samples(sequence: EventDepthSequence) -> list[Sample]:
    return list(SampledSequence(sequence, 0.0, None, 0.05))


def judged(sequence: EventDepthSequence, given: list[Sample] | None = None) -> Consistency:
    slam = tracked(sequence, given or samples(sequence))
    found = slam.tracker.consistency(slam.trajectory)
    assert found is not None
    assert found.num_frames >= 10
    return found


@pytest.mark.parametrize(("noise", "rate"), [("none", None), ("kinect", None), ("kinect", 10.0)])
def test_a_right_recording_has_no_problem(
    sequence: EventDepthSequence, noise: str, rate: float | None
) -> None:
    found = judged(AlteredSequence(sequence, noise, rate))
    assert found.problems == []
    assert abs(found.depth_delay_s) < 0.004


@pytest.mark.parametrize("delay", [0.025, -0.025])
def test_a_delay_of_depth_is_measured(sequence: EventDepthSequence, delay: float) -> None:
    given = samples(sequence)
    # Depth of the neighbouring image, 50 ms away, mixed in would be no image of any time: shift the events.
    moved = [
        replace(s, events=sequence.events(s.timestamp - 0.05 + delay, s.timestamp + delay)) for s in given
    ]
    found = judged(sequence, moved)
    assert found.depth_delay_s == pytest.approx(delay, abs=0.012)
    assert any("late" in p if delay > 0 else "early" in p for p in found.problems)


def test_a_wrong_focal_length_contradicts(sequence: EventDepthSequence) -> None:
    found = judged(OtherFocalLength(sequence, 1.1))
    assert any("contradict each other" in p for p in found.problems)


def test_depth_that_has_stopped_is_named(sequence: EventDepthSequence) -> None:
    given = samples(sequence)
    frozen = [s if k < 8 else replace(s, depth=given[8].depth) for k, s in enumerate(given)]
    slam = tracked(sequence, frozen)
    found = slam.tracker.consistency(slam.trajectory)
    assert found is not None
    assert "the depth stream has stopped" in found.problems[0]


def test_too_few_frames_give_no_result(sequence: EventDepthSequence) -> None:
    slam = tracked(sequence, samples(sequence)[:8])
    assert slam.tracker.consistency(slam.trajectory) is None


def test_a_handful_of_events_contradicts_nothing(sequence: EventDepthSequence) -> None:
    def thinned(events: Events) -> Events:
        return Events.concatenate([events[:: max(1, len(events) // 3)], Events.empty()])

    few = [replace(s, events=thinned(s.events)) for s in samples(sequence)]
    slam = tracked(sequence, few)
    found = slam.tracker.consistency(slam.trajectory)
    assert found is None or found.problems == []


def test_a_rotation_of_depth_is_found_and_taken_back(sequence: EventDepthSequence) -> None:
    rotation = np.radians([0.0, 0.0, 1.5])
    spoiled = ShiftedDepth(TurnedDepth(sequence, -rotation), -0.015)
    found = calibrate_depth(spoiled, Config(), lambda what: None)
    assert found.delay == pytest.approx(0.015, abs=0.003)
    assert np.degrees(found.rotation - rotation) == pytest.approx(np.zeros(3), abs=0.5)
    assert found.after < 0.5 * found.before
