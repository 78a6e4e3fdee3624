"""The loop: any tracker and any mapper over one trajectory."""

from dataclasses import replace

import numpy as np
import pytest
from sequences import make_slam, settings

from edslam_ti.camera import Camera
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.events import Events
from edslam_ti.frame import Frame, FrameBuilder
from edslam_ti.slam import Slam
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.trajectory import Trajectory

CAMERA = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)


class Follower:
    """A tracker that returns what it is told to expect, one centimetre to the right of it at frame 1."""

    def __init__(self) -> None:
        self.guesses: list[np.ndarray] = []

    def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        assert len(trajectory) == len(self.guesses)  # only the poses before it
        self.guesses.append(guess)
        pose = guess.copy()
        if len(self.guesses) == 2:
            pose[0, 3] += 0.01
        return TrackingResult(pose, len(self.guesses) != 3, 1.0)

    def consistency(self, trajectory: Trajectory) -> None:
        """Say nothing."""


def run(mapper: object = None) -> tuple[Slam, Follower]:
    start = np.eye(4)
    start[2, 3] = 5.0
    tracker = Follower()
    slam = Slam(FrameBuilder(CAMERA), tracker, mapper, start)  # type: ignore[arg-type]
    for k in range(4):
        slam.process(Sample(0.1 * k, Events.empty(), depth=None), is_held_out=k == 2)
    return slam, tracker


def test_first_pose_is_the_initial_one_and_later_guesses_keep_the_velocity() -> None:
    slam, tracker = run()
    assert [g[2, 3] for g in tracker.guesses] == [5.0] * 4
    np.testing.assert_allclose([g[0, 3] for g in tracker.guesses], [0, 0, 0.02, 0.03], atol=1e-12)
    np.testing.assert_allclose(slam.trajectory.timestamps, [0, 0.1, 0.2, 0.3])


def test_lost_frames_are_counted_and_do_not_end_the_run() -> None:
    slam, _ = run()
    assert [result.converged for result in slam.results] == [True, True, False, True]
    assert slam.tracking_seconds > 0


def test_tracker_corrections_change_the_trajectory_but_not_the_frontend_one() -> None:
    class Hindsight(Follower):
        def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
            result = super().track(frame, guess, trajectory)
            better = result.T_world_camera.copy()
            better[1, 3] = 0.5
            return replace(result, corrections={1: better} if len(trajectory) == 3 else {})

    slam = Slam(FrameBuilder(CAMERA), Hindsight(), None, np.eye(4))
    for k in range(4):
        slam.process(Sample(0.1 * k, Events.empty(), depth=None))
    assert [T[1, 3] for T in slam.trajectory.poses] == [0, 0.5, 0, 0]
    assert [T[1, 3] for T in slam.frontend_trajectory.poses] == [0, 0, 0, 0]
    assert all(not r.corrections for r in slam.results)  # not kept twice


def test_mapper_gets_every_frame_after_its_pose_and_knows_what_is_held_out() -> None:
    seen: list[tuple[float, int, bool]] = []

    class Recorder:
        def update(self, frame: Frame, trajectory: Trajectory) -> None:
            seen.append((frame.timestamp, len(trajectory), frame.is_held_out))

    run(Recorder())
    assert [n for _, n, _ in seen] == [1, 2, 3, 4]
    assert [held for _, _, held in seen] == [False, False, True, False]


def test_depth_that_the_tracker_distrusts_is_kept_from_the_map() -> None:
    depth = np.ones(CAMERA.shape, np.float32)
    seen: list[bool] = []
    forgotten: list[list[int]] = []

    class Doubtful(Follower):
        def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
            result = super().track(frame, guess, trajectory)
            return replace(result, distrusted={2: (2,), 3: (0, 1)}.get(len(trajectory), ()))

    class Recorder:
        def update(self, frame: Frame, trajectory: Trajectory) -> None:
            seen.append(frame.depth is not None)

        def forget_depth(self, frames: list[int], trajectory: Trajectory) -> None:
            forgotten.append(frames)

    slam = Slam(FrameBuilder(CAMERA), Doubtful(), Recorder(), np.eye(4))  # type: ignore[arg-type]
    for k in range(4):
        slam.process(Sample(0.1 * k, Events.empty(), depth=depth))
    assert seen == [True, True, False, True]
    assert forgotten == [[0, 1]]


@pytest.mark.slow
def test_mapping_while_tracking_keeps_the_tracked_poses(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    # The young map's errors must not pull poses along: the loop alone gives what tracking alone gives.
    few = {"iterations": 1}
    poses = []
    for enabled in (True, False):
        slam = make_slam(tiny_sequence, tiny_samples, settings(mapping=few | {"enabled": enabled}))
        for sample in tiny_samples[:6]:
            slam.process(sample)
        poses.append(slam.trajectory.poses)
    assert (poses[0] == poses[1]).all()
