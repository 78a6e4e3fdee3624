"""A tiny simulated room and recordings of it, made once for all tests that need data of every kind."""

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.evaluation.trajectories import trajectory_errors
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.events import Events
from edslam_ti.frame import FrameBuilder
from edslam_ti.methods import METHODS
from edslam_ti.simulation import HandHeldPath, Room, SimulationConfig, simulate
from edslam_ti.simulation.rooms import RoomBuilder
from edslam_ti.simulation.scene import Material
from edslam_ti.simulation.textures import abstract
from edslam_ti.slam import Slam
from edslam_ti.tracking.tracker import TruePoses

# 15 depth images, 30 cm of path: long enough to drift, short enough to map within seconds.
TINY = SimulationConfig(width=120, height=80, duration=0.7)


@functools.cache
def tiny_room() -> Room:
    """Return a room of 3 m x 3 m with discs and bars on its walls and two boxes; unlit, so made at once."""
    builder = RoomBuilder(seed=3, width=3.0, depth=3.0, height=2.4)

    def painted() -> Material:
        # Discs of 11 to 48 cm: 3 to 14 pixels at 2 m, which such a small image can show.
        return Material(builder.texture(abstract(builder.rng)), texel=0.008)

    builder.shell(
        {side: painted() for side in ("north", "east", "south", "west")},
        floor=painted(),
        ceiling=painted(),
        skirting=painted(),
    )
    builder.box((0.3, 2.3, 0.0), (1.1, 2.9, 0.9), painted())
    builder.box((2.2, 2.0, 0.0), (2.8, 2.5, 1.3), painted())
    sights = np.array([[0.7, 2.6, 0.9], [1.6, 3.0, 1.4], [2.5, 2.2, 1.1], [1.4, 3.0, 0.8]])
    scene = builder.build("tiny test room")
    return Room("tiny", scene, np.array([1.0, 0.5, 1.0]), np.array([2.0, 1.2, 1.6]), sights)


def record_tiny_room(folder: Path, **differences: object) -> Path:
    """Write a recording of the tiny room in EventReplica's layout to `folder`; returns it."""
    settings = SimulationConfig(**(TINY.model_dump() | differences))
    room = tiny_room()
    simulate(room.scene, HandHeldPath(room, settings.duration), settings, folder)
    return folder


def settings(method: str = "ed_slam", **differences: Any) -> Config:
    """Return a method's settings with differences, as the command line would make them."""
    return Config(method=method).updated(dict(METHODS[method].overrides)).updated(differences)


def make_slam(sequence: EventDepthSequence, samples: list[Sample], config: Config) -> Slam:
    """Return a method ready to start at the true pose of the first sample."""
    assert sequence.contrast_threshold is not None
    assert samples[0].T_world_camera is not None
    tracker, mapper = METHODS[config.method].build(
        sequence, ContrastThreshold(sequence.contrast_threshold, "data"), config
    )
    return Slam(
        FrameBuilder(sequence.camera),
        TruePoses(sequence.true_pose) if config.poses == "truth" else tracker,
        mapper if config.mapping.enabled else None,
        initial_pose=samples[0].T_world_camera,
    )


def tracked(sequence: EventDepthSequence, samples: list[Sample], config: Config | None = None) -> Slam:
    """Return what tracking alone makes of the samples."""
    config = config or settings()
    slam = make_slam(sequence, samples, config.updated({"mapping": {"enabled": False}}))
    for sample in samples:
        slam.process(sample)
    return slam


def position_errors(slam: Slam, sequence: EventDepthSequence) -> np.ndarray:  # [F] metres
    """Return the distance of every pose from the truth; both start at the same pose."""
    truth = [sequence.true_pose(t) for t in slam.trajectory.timestamps]
    return np.linalg.norm(slam.trajectory.poses[:, :3, 3] - np.array(truth)[:, :3, 3], axis=1)


def ate_cm(slam: Slam, sequence: EventDepthSequence) -> float:
    """Return the rmse of the aligned trajectory in centimetres."""
    assert sequence.truth is not None
    truth = sequence.truth.resampled(slam.trajectory.timestamps)
    return trajectory_errors(slam.trajectory, truth).ate_rmse_cm


def without_events(sample: Sample) -> Sample:
    return replace(sample, events=Events.empty())


def without_depth(sample: Sample) -> Sample:
    return replace(sample, depth=None)


def there_and_back(samples: list[Sample]) -> list[Sample]:
    """Return a recording that goes back on its own path: events in reverse, with the other polarity."""
    end = samples[-1].timestamp
    result = list(samples)
    for before, after in zip(samples[-2::-1], samples[:0:-1]):
        x, y, t, polarity = (
            a[::-1] for a in (after.events.x, after.events.y, after.events.t, after.events.polarity)
        )
        events = Events(x.copy(), y.copy(), 2 * end - t, -polarity)
        result.append(replace(before, timestamp=2 * end - before.timestamp, events=events))
    return result


def with_depth_scaled(sample: Sample, factor: float) -> Sample:
    assert sample.depth is not None
    return replace(sample, depth=sample.depth * np.float32(factor))
