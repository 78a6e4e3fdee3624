"""Recent frames of uninterrupted events, aligned to a keyframe and solved for its image, along a path."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edslam_ti.config import TrackingConfig
from edslam_ti.geometry import inverse
from edslam_ti.kernels.patch_warp import NormalEquations
from edslam_ti.tracking.keyframes import (
    Aligned,
    BrightnessFrame,
    BrightnessKeyframe,
    Depth,
    KeyframeAligner,
)
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.tracking.uncertainty import measured
from edslam_ti.trajectory import PathDraft


@dataclass
class Segment:
    """The last frames since events were missing, and how they are aligned."""

    aligner: KeyframeAligner
    config: TrackingConfig
    start: int = 0  # first frame of the segment
    recent: list[BrightnessFrame] = field(default_factory=list)

    @property
    def with_depth(self) -> list[BrightnessFrame]:
        """The recent frames with depth."""
        return [f for f in self.recent if f.depth is not None]

    def begin(self, index: int) -> None:
        """Begin anew with a frame."""
        self.start, self.recent = index, []

    def add(self, frame: BrightnessFrame) -> None:
        """Take in the newest frame."""
        self.recent = [*self.recent, frame][-self.config.images.window :]

    def middle(self, frames: Sequence[BrightnessFrame]) -> BrightnessFrame:
        """Return the one of some frames that is nearest to the middle of the recent ones."""
        middle = self.recent[len(self.recent) // 2].index
        return min(frames, key=lambda f: abs(f.index - middle))

    def since_depth(self, newest: BrightnessFrame) -> list[BrightnessFrame]:
        """Return the frames from the last one with depth up to a new one."""
        for k in range(len(self.recent) - 2, -1, -1):
            if self.recent[k].depth is not None:
                return self.recent[k:]
        return [newest]

    # --- alignment ---

    def align(
        self,
        keyframe: BrightnessKeyframe,
        frame: BrightnessFrame,
        depth: Depth | None,  # what is aligned beside the image
        start: np.ndarray,  # [4, 4] T_world_camera
        path: PathDraft,
    ) -> Aligned:
        """Align a frame to a keyframe."""
        T_keyframe_world = inverse(path.pose(keyframe.index))
        return self.aligner.align(keyframe, keyframe.image_at(frame), depth, T_keyframe_world @ start)

    def judged(
        self, aligned: Aligned, keyframe: BrightnessKeyframe, guess: np.ndarray, path: PathDraft
    ) -> TrackingResult:
        """Return the pose, or the guess and a reason where it cannot be trusted."""
        problem = aligned.problem(self.config)
        T = guess if problem else path.pose(keyframe.index) @ aligned.T_keyframe_camera
        measurement = None if problem else measured(keyframe.index, aligned.last)
        quality = aligned.quality(self.config)
        return TrackingResult(T, not problem, quality, problem, measurement=measurement)

    def without_depth(
        self, keyframe: BrightnessKeyframe, frame: BrightnessFrame, path: PathDraft
    ) -> tuple[np.ndarray, NormalEquations] | None:
        """Return the pose by brightness alone and how well it is determined, or None."""
        T = path.pose(frame.index)
        aligned = self.align(keyframe, frame, None, T, path)
        if frame.index == keyframe.index:
            return T, aligned.system
        result = self.judged(aligned, keyframe, T, path)
        return (result.T_world_camera, aligned.system) if result.converged else None

    def realign(self, keyframe: BrightnessKeyframe, path: PathDraft, fixed: int = 0) -> None:
        """Align recent frames once more, to a better image than they were tracked with, but a fixed one."""
        for frame in self.recent:
            if frame.index in (fixed, keyframe.index):
                continue
            start = path.pose(frame.index)
            result = self.judged(self.align(keyframe, frame, frame.depth, start, path), keyframe, start, path)
            if result.converged:
                path.replace(frame.index, result.T_world_camera)

    # --- a keyframe's image ---

    def new_keyframe(self, frame: BrightnessFrame, log_brightness: np.ndarray) -> BrightnessKeyframe:
        """Return a frame with depth as a keyframe that is yet to be solved for."""
        assert frame.depth is not None
        next_solution = self.recent[-1].index + self.config.images.solve_interval
        return BrightnessKeyframe(
            frame.index, frame.change, frame.depth, frame.depth, log_brightness,
            points=[], depth_points=None, next_solution=next_solution,
        )  # fmt: skip

    def solve(
        self, keyframe: BrightnessKeyframe, path: PathDraft, iterations: int = 8, is_robust: bool = True
    ) -> None:
        """Solve for the keyframe's image from recent frames, and choose its pixels to align."""
        others = [f for f in self.recent if f.index != keyframe.index]
        count = min(len(others), self.config.images.observations)
        frames = [others[round(k)] for k in np.linspace(0, len(others) - 1, count)]
        T_world_keyframe = path.pose(keyframe.index)
        poses = [inverse(path.pose(f.index)) @ T_world_keyframe for f in frames]
        self.aligner.solve(keyframe, frames, poses, iterations, is_robust)
