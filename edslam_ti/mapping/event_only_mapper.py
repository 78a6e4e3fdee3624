"""A map from events alone, with given poses: Gaussians at random depth, moved by the event loss.

Event3DGS (Xiong et al. 2024) as the paper's authors re-implemented it for comparison: known poses, no depth.
Where the map shows nothing yet, Gaussians are placed at random depth along the rays. The loss between two
renders (Eq. 10 to 12) moves them to where the changes agree, coarse to fine.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.frame import Frame
from edslam_ti.mapping.budget import prune_faded, stride_for_budget
from edslam_ti.mapping.change_loss import Reduction
from edslam_ti.mapping.change_mapper import ChangeMapper
from edslam_ti.mapping.insertion import spaced
from edslam_ti.trajectory import Trajectory

COARSEST = 96  # pixels, about: images are halved until they are as wide, and the steps begin there
# Radians; depth is found in cells of these sizes, one after the other, seen from the middle of the path.
CELLS = (*(0.3, 0.3, 0.2, 0.2, 0.15, 0.15), *(0.1, 0.1, 0.1, 0.06, 0.06, 0.06, 0.06))
LAST_CELL = 0.03  # radians, of cells that are moved between the final steps
COARSE_CELL = 0.15  # from this size on the coarsest images are used, for smaller ones images twice as large
DISTANCES = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 4.0)  # of the first guess, tried for all Gaussians together
FINEST_SHARE = 0.4  # of the final steps are taken on full images


class EventOnlyMapper(ChangeMapper):
    """Fills what it sees with Gaussians at random depth, and lets events decide (Mapper)."""

    def __init__(self, camera: Camera, contrast: ContrastThreshold, config: Config) -> None:
        super().__init__(camera, contrast, config)
        self._event_only = config.event_only
        self._moves_depth = True
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

    def _begin_final(self, trajectory: Trajectory) -> None:
        """Find the distance of everything, then depth in ever smaller cells, in turn with brightness."""
        if not self._settings.solve_views:
            return
        frames = self._sums.frames
        self._try_distances(trajectory)
        for cell in CELLS:
            self.solve_brightness(trajectory, frames)
            level = self._coarsest if cell >= COARSE_CELL else self._coarsest - 1
            self.solve_depth(trajectory, frames, max(level, 0), cell)

    def _try_distances(self, trajectory: Trajectory) -> None:
        """Move all Gaussians away from the middle of the path, or nearer, as events say."""
        frames, middle = self._sums.frames, torch.from_numpy(trajectory.poses[:, :3, 3].mean(0)).float()
        raw, everyone = self.gaussians.raw, torch.arange(len(self.gaussians))
        away, log_scales = raw["means"].detach() - middle, raw["log_scales"].detach().clone()

        def place(factor: float) -> None:
            self.gaussians.overwrite("means", everyone, middle + factor * away)
            self.gaussians.overwrite("log_scales", everyone, log_scales + math.log(factor))

        errors = []
        for factor in DISTANCES:
            place(factor)
            self.solve_brightness(trajectory, frames)
            errors.append(self.unexplained(trajectory, frames))
        place(DISTANCES[int(np.argmin(errors))])

    def unexplained(self, trajectory: Trajectory, frames: Sequence[int]) -> float:
        """Return the share of the change between some frames that the map leaves unexplained."""
        reduction, knots = Reduction.of(self._camera, self._coarsest), self._spread_knots(frames)
        logs = [
            reduction.reduced((self._view(trajectory.at(k.time)).intensity + self._config.log_epsilon).log())
            for k in knots
        ]
        wrong, total = 0.0, 0.0
        for pair in self._pairs(knots, (1, max(len(knots) // 2, 1))):
            change = reduction.reduced(pair.change)
            wrong += float((logs[pair.end] - logs[pair.start] - change).square().mean())
            total += float(change.square().mean())
        return wrong / max(total, 1e-12)

    def _final_step(self, number: int, trajectory: Trajectory, free: range | None) -> None:
        level = self._level(number / self._config.final_iterations)
        if self._settings.solve_views and number % self._event_only.solve_steps == 0:
            prune_faded(self.gaussians, self._event_only.min_opacity)
            if number and self._moves_depth:
                self.solve_depth(trajectory, self._sums.frames, max(level - 1, 0), LAST_CELL)
            self.solve_brightness(trajectory, self._sums.frames)
        window = self.window(self._sampler.any(self._sums.frames))
        if window is not None:
            self.step(*window, trajectory, free, level)
