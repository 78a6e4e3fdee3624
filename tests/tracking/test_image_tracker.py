"""Tracking against brightness images: between depth images, over gaps, and where geometry says nothing."""

from dataclasses import replace

import numpy as np
import pytest
from sequences import (
    ate_cm,
    position_errors,
    record_tiny_room,
    settings,
    tracked,
    without_depth,
    without_events,
)

from edslam_ti.datasets import EventDepthSequence, Sample, SampledSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.slam import Slam
from edslam_ti.tracking import image_tracker

GAP = range(16, 22)  # frames, a quarter of a second


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> EventDepthSequence:
    return EventReplicaSequence(record_tiny_room(tmp_path_factory.mktemp("longer") / "tiny", duration=1.6))


@pytest.fixture(scope="module")
def samples(sequence: EventDepthSequence) -> list[Sample]:
    return list(SampledSequence(sequence, 0.0, None, 0.05))


def sparse(samples: list[Sample], every: int) -> list[Sample]:
    return [s if k % every == 0 else without_depth(s) for k, s in enumerate(samples)]


def messages(slam: Slam) -> str:
    return " / ".join(result.message for result in slam.results)


def lost(slam: Slam) -> list[int]:
    return [k for k, result in enumerate(slam.results) if not result.converged]


def test_brightness_images_are_better_than_time_surfaces_between_depth_images(
    sequence: EventDepthSequence, samples: list[Sample]
) -> None:
    by_brightness = tracked(sequence, sparse(samples, 4))
    by_surfaces = tracked(sequence, sparse(samples, 4), settings(tracking={"brightness": False}))
    assert "first brightness image" in messages(by_brightness)
    assert lost(by_brightness) == []
    assert ate_cm(by_brightness, sequence) < 0.7 * ate_cm(by_surfaces, sequence)


def test_poses_between_depth_images_are_corrected_when_the_next_one_comes(
    sequence: EventDepthSequence, samples: list[Sample]
) -> None:
    slam = tracked(sequence, sparse(samples, 4))
    as_tracked = np.array([result.T_world_camera for result in slam.results])
    moved = np.linalg.norm(as_tracked[:, :3, 3] - slam.trajectory.poses[:, :3, 3], axis=1)
    settled = [k for k in range(12, 28) if k % 4]
    assert (moved[settled] > 0).all()
    truth = np.array([sequence.true_pose(t) for t in slam.trajectory.timestamps])[:, :3, 3]
    before = np.linalg.norm(as_tracked[settled, :3, 3] - truth[settled], axis=1)
    assert position_errors(slam, sequence)[settled].mean() < before.mean()


def test_depth_carries_over_a_gap_in_the_events_and_a_new_image_follows(
    sequence: EventDepthSequence, samples: list[Sample]
) -> None:
    gappy = [without_events(s) if k in GAP else s for k, s in enumerate(samples)]
    slam = tracked(sequence, gappy)
    assert "events are missing" in slam.results[GAP.start].message
    after = " / ".join(result.message for result in slam.results[GAP.stop :])
    assert "relocalised by the place of frame" in after or "no place recognised" in after
    assert lost(slam) == []
    assert ate_cm(slam, sequence) < 0.5


def test_events_carry_over_a_gap_in_the_depth(sequence: EventDepthSequence, samples: list[Sample]) -> None:
    slam = tracked(sequence, [without_depth(s) if k in GAP else s for k, s in enumerate(samples)])
    assert lost(slam) == []
    assert ate_cm(slam, sequence) < 0.5


def test_a_camera_that_stops_keeps_its_image(
    sequence: EventDepthSequence, samples: list[Sample], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(image_tracker, "SILENT_FLOW", np.inf)  # as if it had been slow before
    last = samples[11]
    pause = [replace(without_events(last), timestamp=last.timestamp + 0.05 * k) for k in range(1, 5)]
    slam = tracked(sequence, [*samples[:12], *pause])
    assert "events are missing" not in messages(slam)
    moved = slam.trajectory.poses[12:, :3, 3] - slam.trajectory.pose(11)[:3, 3]
    assert np.linalg.norm(moved, axis=1).max() < 0.002


def test_same_seed_gives_the_same_bits(sequence: EventDepthSequence, samples: list[Sample]) -> None:
    runs = [tracked(sequence, sparse(samples, 2)[:16]) for _ in range(2)]
    assert (runs[0].trajectory.poses == runs[1].trajectory.poses).all()
