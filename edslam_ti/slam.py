"""ED-SLAM as in Fig. 1 of the paper: events and depth in, trajectory and map out."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from edslam_ti.datasets.base import Sample
from edslam_ti.frame import FrameBuilder
from edslam_ti.mapping.mapper import Mapper
from edslam_ti.tracking.tracker import Tracker, TrackingResult
from edslam_ti.trajectory import Trajectory


@dataclass
class Slam:
    """The loop of all methods: a tracker and a mapper that share one trajectory."""

    frame_builder: FrameBuilder
    tracker: Tracker
    mapper: Mapper | None  # None: tracking only
    initial_pose: np.ndarray  # [4, 4] T_world_camera of the first frame

    def __post_init__(self) -> None:
        self.trajectory = Trajectory()
        self.results: list[TrackingResult] = []
        self.tracking_seconds = 0.0
        self.mapping_seconds = 0.0
        self.on_tracked: Callable[[], None] | None = None  # called when a pose is known, before it is mapped

    @property
    def frontend_trajectory(self) -> Trajectory:
        """The poses as they were tracked, before the mapper corrected any."""
        return Trajectory(self.trajectory.timestamps, np.array([r.T_world_camera for r in self.results]))

    def process(self, sample: Sample, is_held_out: bool = False) -> TrackingResult:
        """Track one sample and map it; the depth of a held-out sample is not mapped."""
        frame = self.frame_builder.build(sample, is_held_out)
        started = time.perf_counter()
        guess = self.trajectory.at(frame.timestamp) if len(self.trajectory) else self.initial_pose
        result = self.tracker.track(frame, guess, self.trajectory)  # Eq. 1-5
        for index, T_world_camera in result.corrections.items():  # loop closure, smoothing
            self.trajectory.replace(index, T_world_camera)
        self.trajectory.append(frame.timestamp, result.T_world_camera)
        self.results.append(replace(result, corrections={}))  # the trajectory holds them
        tracked = time.perf_counter()
        if self.on_tracked is not None:
            self.on_tracked()
        if self.mapper is not None:
            if len(self.results) - 1 in result.distrusted:
                frame = replace(frame, depth=None)
            self.mapper.update(frame, self.trajectory)  # Eq. 6-16
            if earlier := [k for k in result.distrusted if k < len(self.results) - 1]:
                self.mapper.forget_depth(earlier, self.trajectory)
        self.tracking_seconds += tracked - started
        self.mapping_seconds += time.perf_counter() - tracked
        return result
