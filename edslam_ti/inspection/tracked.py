"""Runs the tracker on a part of a recording, for what it says about events and depth together."""

from dataclasses import dataclass

import numpy as np

from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, SampledSequence
from edslam_ti.errors import DataError
from edslam_ti.event_images.own_sensor import own_sensor
from edslam_ti.frame import FrameBuilder
from edslam_ti.slam import Slam
from edslam_ti.tracking.consistency import Consistency, Misalignment
from edslam_ti.tracking.image_tracker import BrightnessTracker
from edslam_ti.trajectory import Trajectory

MOST_FRAMES = 120


@dataclass(frozen=True)
class Tracked:
    """The path of a part of a recording, and how events and depth agreed on it."""

    trajectory: Trajectory
    lost_share: float
    consistency: Consistency | None  # None: too few frames could be compared
    misalignment: Misalignment | None  # the same


def track(sequence: EventDepthSequence, start: float, end: float, config: Config) -> Tracked | None:
    """Return what the tracker finds between two times (s); None: there is too little to track.

    Taichi must have been started.
    """
    first = min([sequence.time_range[0], *sequence.depth_timestamps[:1]])
    try:
        samples = SampledSequence(sequence, max(start - first, 0.0), end - start, config.max_interval)
    except DataError:
        return None
    contrast, _ = own_sensor(config.contrast_threshold, config.dead_time, sequence, start, end)
    tracker = BrightnessTracker(sequence.camera, contrast, config.time_surface, config.tracking, config.seed)
    truth = sequence.true_pose(float(samples.timestamps[0]))
    slam = Slam(
        FrameBuilder(sequence.camera, contrast.dead_time),
        tracker,
        None,
        np.eye(4) if truth is None else truth,
    )
    for k in range(min(len(samples), MOST_FRAMES)):
        sample, _ = samples.as_far_as_readable(k)
        slam.process(sample)
    lost = float(np.mean([not result.converged for result in slam.results]))
    path = slam.trajectory
    return Tracked(path, lost, tracker.consistency(path), tracker.misalignment(path))
