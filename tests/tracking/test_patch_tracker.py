"""The tracker on the tiny room: accuracy in centimetres, and what happens when its input fails."""

from dataclasses import replace

import numpy as np
import pytest
from sequences import ate_cm, position_errors, settings, tracked, without_depth, without_events

from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.kernels.patch_warp import Alignment, NormalEquations
from edslam_ti.slam import Slam
from edslam_ti.tracking.tracker import Attempt, TrackingResult, TruePoses, best_attempt
from edslam_ti.trajectory import Trajectory

PAPER = settings("ed_slam_paper")


@pytest.fixture(scope="module")
def run(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> Slam:
    return tracked(tiny_sequence, tiny_samples)


def lost(slam: Slam) -> list[int]:
    return [k for k, result in enumerate(slam.results) if not result.converged]


def test_room_is_tracked_to_a_millimetre(run: Slam, tiny_sequence: EventDepthSequence) -> None:
    assert lost(run) == []
    assert ate_cm(run, tiny_sequence) < 0.15  # 0.03 to 0.08 cm were measured
    assert position_errors(run, tiny_sequence).max() < 0.004  # unaligned, so the drift counts: 0.0014 m


def test_event_surfaces_alone_are_tracked_to_a_centimetre(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    slam = tracked(tiny_sequence, tiny_samples, PAPER)
    assert lost(slam) == []
    assert ate_cm(slam, tiny_sequence) < 1.0  # 0.33 cm was measured


@pytest.mark.slow
def test_compositional_form_finds_nearly_the_same_poses(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    additive, compositional = (
        tracked(tiny_sequence, tiny_samples, settings(tracking={"brightness": False, "form": form}))
        for form in ("additive", "compositional")
    )
    assert lost(compositional) == []
    assert ate_cm(compositional, tiny_sequence) < 0.15
    assert not np.array_equal(compositional.trajectory.poses, additive.trajectory.poses)


def test_one_direction_is_enough_in_a_small_room_and_differs(
    run: Slam, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    forward = tracked(tiny_sequence, tiny_samples, settings(tracking={"directions": "forward"}))
    assert all(result.converged for result in forward.results)
    assert position_errors(forward, tiny_sequence).max() < 0.006  # unaligned; 0.0033 m was measured
    assert not np.array_equal(forward.trajectory.poses, run.trajectory.poses)


def test_quality_is_one_at_the_first_frame_and_a_fraction_after(run: Slam) -> None:
    qualities = [result.quality for result in run.results]
    assert qualities[0] == 1
    assert all(0.3 < q < 1 for q in qualities[1:])


def test_same_seed_gives_the_same_bits_and_another_seed_does_not(
    run: Slam, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    again = tracked(tiny_sequence, tiny_samples)
    assert (again.trajectory.poses == run.trajectory.poses).all()
    other = tracked(tiny_sequence, tiny_samples[:3], settings(seed=1))
    assert (other.trajectory.poses[1:] != run.trajectory.poses[1:3]).any()


@pytest.mark.parametrize("config", [settings(), PAPER], ids=lambda c: c.method)
def test_frames_without_depth_are_tracked_by_the_patches_of_their_reference(
    config: Config, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    samples = [s if k % 2 == 0 else without_depth(s) for k, s in enumerate(tiny_samples)]
    slam = tracked(tiny_sequence, samples, config)
    assert lost(slam) == []
    assert ate_cm(slam, tiny_sequence) < 1.2  # 0.39 to 0.58 cm: surfaces alone on every second frame


def blacked_out(samples: list[Sample]) -> list[Sample]:
    return [without_events(s) if k in (6, 7) else s for k, s in enumerate(samples)]


def test_depth_alone_carries_over_a_blackout_of_events(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    slam = tracked(tiny_sequence, blacked_out(tiny_samples))
    assert lost(slam) == []
    assert position_errors(slam, tiny_sequence).max() < 0.004


@pytest.mark.slow
@pytest.mark.parametrize("depth", ["absent", "all zero"])
def test_frames_that_show_nothing_are_predicted_and_tracking_recovers(
    depth: str, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    samples = blacked_out(tiny_samples)
    for k in (6, 7):
        nothing = None if depth == "absent" else np.zeros(tiny_sequence.camera.shape, np.float32)
        samples[k] = replace(samples[k], depth=nothing)
    slam = tracked(tiny_sequence, samples)
    assert lost(slam) == [6, 7]
    assert "too few events" in slam.results[6].message
    predicted = tracked(tiny_sequence, samples[:6]).trajectory.at(samples[6].timestamp)
    assert (slam.trajectory.pose(6) == predicted).all()  # constant velocity
    errors = position_errors(slam, tiny_sequence)
    assert errors[6:8].max() < 0.02
    assert errors[8:].max() < 0.004  # back at the accuracy of a run without the blackout


def test_surface_trackers_lose_a_blackout_and_never_align_to_it(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    # Consecutive frames: were the dark frame 7 a reference, frame 8 would have nothing to align to.
    slam = tracked(tiny_sequence, blacked_out(tiny_samples), PAPER)
    assert lost(slam) == [6, 7]
    assert ate_cm(slam, tiny_sequence) < 1.2


@pytest.mark.parametrize("config", [settings(), PAPER], ids=lambda c: c.method)
def test_depth_image_of_zeros_does_not_end_a_run(
    config: Config, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    zeros = np.zeros(tiny_sequence.camera.shape, np.float32)
    samples = [replace(s, depth=zeros) if k in (6, 7) else s for k, s in enumerate(tiny_samples)]
    slam = tracked(tiny_sequence, samples, config)
    assert set(lost(slam)) <= {6, 7}
    assert ate_cm(slam, tiny_sequence) < 1.0


def test_run_may_start_with_a_depth_image_of_zeros(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    first = replace(tiny_samples[0], depth=np.zeros(tiny_sequence.camera.shape, np.float32))
    slam = tracked(tiny_sequence, [first, *tiny_samples[1:]])
    assert ate_cm(slam, tiny_sequence) < 1.0


@pytest.mark.parametrize(("config", "uses_depth"), [(settings(), True), (PAPER, False)])
def test_only_the_combined_objective_has_depth_residuals(
    config: Config,
    uses_depth: bool,
    tiny_sequence: EventDepthSequence,
    tiny_samples: list[Sample],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    counts: list[int] = []
    linearise = Alignment.linearise

    def counting(self: Alignment, poses: list[np.ndarray]) -> list[NormalEquations]:
        systems = linearise(self, poses)
        counts.extend(system.num_depth for system in systems)
        return systems

    monkeypatch.setattr(Alignment, "linearise", counting)
    tracked(tiny_sequence, tiny_samples[:3], config)
    assert len(counts) > 2
    assert any(counts) == uses_depth


def test_true_poses_are_the_truth_and_lost_where_there_is_none(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    slam = tracked(tiny_sequence, tiny_samples, settings(poses="truth"))
    assert position_errors(slam, tiny_sequence).max() == 0
    guess = np.eye(4)
    result = TruePoses(lambda t: None).track(
        slam.frame_builder.build(replace(tiny_samples[0], timestamp=0.71)), guess, Trajectory()
    )
    assert not result.converged
    assert (result.T_world_camera == guess).all()


def test_a_doubtful_attempt_is_followed_by_one_from_the_last_pose_and_the_better_counts() -> None:
    predicted, last = np.eye(4), 2 * np.eye(4)
    starts: list[float] = []

    def best(is_sure: bool, quality_from_last: float) -> float:
        def attempt(start: np.ndarray) -> Attempt:
            starts.append(start[0, 0])
            is_last = start is last
            quality = quality_from_last if is_last else 0.5
            return Attempt(TrackingResult(start, True, quality), is_sure, overlap=1.0)

        starts.clear()
        return float(best_attempt(attempt, predicted, last).result.T_world_camera[0, 0])

    assert (best(True, 0.9), starts) == (1.0, [1.0])
    assert (best(False, 0.9), starts) == (2.0, [1.0, 2.0])
    assert (best(False, 0.1), starts) == (1.0, [1.0, 2.0])
