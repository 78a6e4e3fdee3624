"""A map from events alone, with given poses: Gaussians at random depth, moved by the event loss.

Event3DGS (Xiong et al. 2024) as the paper's authors re-implemented it for comparison: known poses, no depth.
Where the map shows nothing yet, Gaussians are placed at random depth along the rays. The loss between two
renders (Eq. 10 to 12) moves them to where the changes agree, coarse to fine.
"""

import math

import numpy as np
import torch

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.frame import Frame
from edslam_ti.mapping.budget import prune_faded, stride_for_budget
from edslam_ti.mapping.change_mapper import ChangeMapper
from edslam_ti.mapping.insertion import spaced
from edslam_ti.trajectory import Trajectory

COARSEST = 96  # pixels, about: images are halved until they are as wide, and the steps begin there
FINEST_SHARE = 0.2  # of the final steps are taken on full images


class EventOnlyMapper(ChangeMapper):
    """Fills what it sees with Gaussians at random depth, and lets events decide (Mapper)."""

    def __init__(self, camera: Camera, contrast: ContrastThreshold, config: Config) -> None:
        super().__init__(camera, contrast, config)
        self._event_only = config.event_only
        self._coarsest = max(0, round(math.log2(camera.width / COARSEST)))

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Add the frame's events, Gaussians where the map shows nothing, and take some steps."""
        self.budget.start(frame.timestamp)
        index = self._num_frames
        self._num_frames += 1
        self._sums.add(frame, index)
        self._fill(trajectory.pose(-1), index)
        self._drop_surplus()
        self._optimise_online(trajectory)
        self.budget.stop()

    def _fill(self, T_world_camera: np.ndarray, index: int) -> None:
        """Add Gaussians at random depth where the map shows nothing from a pose."""
        config, camera = self._config, self._camera
        remaining = config.max_gaussians - len(self.gaussians)
        stride = stride_for_budget(config.pixel_stride, len(self.gaussians) / config.max_gaussians)
        is_empty = self._view(T_world_camera).alpha.numpy() < config.min_visibility
        v, u = np.nonzero(is_empty & spaced(np.full(camera.shape, stride)))
        v, u = v[:remaining], u[:remaining]
        if len(v) == 0:
            return
        depth = self._random.uniform(self._event_only.nearest, self._event_only.farthest, len(v))
        points = camera.back_project_pixels(u, v, depth) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        size = config.initial_size * stride * depth / camera.fx
        number = len(v)
        self.gaussians.add(
            torch.from_numpy(points.astype(np.float32)),
            torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(number, 4).contiguous(),
            torch.from_numpy(size.astype(np.float32))[:, None].expand(number, 3).contiguous(),
            config.initial_opacity,
            torch.full((number, 1), config.background),
            index,
        )

    def _drop_surplus(self) -> None:
        """Drop every second of the older chunks when there are too many."""
        frames = self._sums.frames
        if len(frames) > self._config.max_views:
            for k in frames[1 : len(frames) // 2 : 2]:
                self._sums.drop(k)

    def _level(self, done: float) -> int:
        """Return by which power of two images are halved when a share of the final steps is done."""
        if done >= 1 - FINEST_SHARE:
            return 0
        return math.ceil(self._coarsest * (1 - done / (1 - FINEST_SHARE)))

    def _optimise_online(self, trajectory: Trajectory) -> None:
        for _ in range(self._config.iterations):
            window = self.window(self._sampler.recent(self._sums.frames))
            if window is not None:
                self.step(*window, trajectory, free=None, level=self._coarsest)

    def _final_step(self, number: int, trajectory: Trajectory, free: range | None) -> None:
        if self._settings.solve_views and number % self._event_only.solve_steps == 0:
            prune_faded(self.gaussians, self._event_only.min_opacity)
            self.solve_brightness(trajectory, self._sums.frames)
        window = self.window(self._sampler.any(self._sums.frames))
        if window is not None:
            self.step(*window, trajectory, free, self._level(number / self._config.final_iterations))
