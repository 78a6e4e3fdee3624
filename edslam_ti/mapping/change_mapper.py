"""The part that all mappers share whose map explains the change between two renders (Eq. 9 to 12)."""

import bisect
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.event_images.sums import EventSums, Knot
from edslam_ti.geometry import inverse
from edslam_ti.mapping.brightness_solve import Pair, solve_brightness
from edslam_ti.mapping.budget import Budget, prune_faded
from edslam_ti.mapping.change_loss import PathPoses, Reduction, change_loss
from edslam_ti.mapping.depth_solve import SeenFrom, solve_depth
from edslam_ti.mapping.gaussians import GaussianMap, Gaussians
from edslam_ti.mapping.losses import scale_loss
from edslam_ti.mapping.mapper import Progress
from edslam_ti.mapping.poses import PoseRefiner
from edslam_ti.mapping.rendering import drawable, render_map
from edslam_ti.mapping.shown_map import ShownMap
from edslam_ti.mapping.targets import FrameSampler, evenly
from edslam_ti.trajectory import Trajectory

ONLINE_SHARE = 0.5  # share of the budget for the steps during the run
ADJUST_FROM = 0.3  # fraction of the final steps after which poses are optimised, too
LAST_RATE = 0.05  # learning rates fall to this share of their values during the final steps
WHITE_LEVEL = 0.93  # brightness given to the brightest percent of pixels
PAIR_STEPS = (1, 2, 4, 8, 16)  # the solve for brightness compares views this many apart
NEAR_STEPS = (1, 2, 4, 8)  # that for depth, too: images further apart hardly overlap
FEWEST_EVENTS = 0.3  # of the wanted number; at the start of the events there may be no more
MIN_VIEWS = 3  # needed before brightness can be solved for


class ChangeMapper(ShownMap):
    """Keeps events as sums, and takes steps on the Gaussians and poses of two moments at a time.

    Subclasses say where Gaussians come from and which chunks are kept.
    """

    def __init__(self, camera: Camera, contrast: ContrastThreshold, config: Config) -> None:
        super().__init__(camera, config.mapping)
        self.loss = float("nan")  # running mean of Eq. 12
        self.num_steps = 0  # taken so far
        self.budget = Budget(config.mapping.budget)
        self._settings = config.change
        self._sums = EventSums(
            camera.shape, *contrast.by_polarity, config.change.knots_per_frame, config.device
        )
        self._random = np.random.default_rng(config.seed + 1)
        self._sampler = FrameSampler(self._random, config.keyframes.num_chunks)
        self._refiner = PoseRefiner(config.mapping.poses_rate)
        self._adjusts_poses = config.mapping.bundle_adjustment and config.poses == "tracked"
        self._num_frames = 0
        self._num_final: int | None = None  # final steps taken; None: not refining

    # --- the protocol's part that is the same for all ---

    def keyframe_indices(self) -> list[int]:
        """Return the frames whose chunks are kept."""
        return self._sums.frames

    def metrics(self) -> dict[str, int | float | None]:
        """Return the numbers of kept chunks, of optimisation steps, and of noisy pixels."""
        return {
            "num_keyframes": len(self.keyframe_indices()),
            "num_mapping_steps": self.num_steps,
            "num_hot_pixels": int(self._sums.noisy_pixels.mask.sum()),
        }

    def forget_depth(self, frames: Sequence[int], trajectory: Trajectory) -> None:
        """Remove the Gaussians from the depth of some frames."""
        self.gaussians.remove_frames(frames)

    def finish(self, trajectory: Trajectory, progress: Progress) -> None:
        """Refine map and poses over all kept chunks, with falling learning rates.

        A mapper restored from its state in mid refinement goes on with the next step.
        """
        self.budget.start()
        total = self._config.final_iterations
        if self._num_final is None and len(self.gaussians) > 0:
            self._num_final = 0
            self._begin_final(trajectory)
        while self._num_final is not None and self._num_final < total and self.budget.left() > 0:
            done = self._num_final / total
            rate = LAST_RATE**done
            self.gaussians.decay_rates(rate)
            self._refiner.rate = self._config.poses_rate * rate
            free = range(len(trajectory)) if self._poses_are_free(done) else None
            self._final_step(self._num_final, trajectory, free)
            self._num_final += 1
            if not progress(self._num_final / total):
                break
        prune_faded(self.gaussians, self._config.min_opacity)
        self._num_final = None
        self.budget.stop()

    def _poses_are_free(self, done: float) -> bool:
        """Return whether the final steps move poses when a share of them is done: the map comes first."""
        return self._adjusts_poses and done >= ADJUST_FROM

    def _begin_final(self, trajectory: Trajectory) -> None:
        """Prepare the final steps."""
        if self._settings.solve_views:
            self.solve_brightness(trajectory, self._sums.frames)

    def _final_step(self, number: int, trajectory: Trajectory, free: range | None) -> None:
        """Take one of the final steps; brightness is solved for again half way and near the end."""
        total = self._config.final_iterations
        if self._settings.solve_views and number in (total // 2, total - total // 10):
            self.solve_brightness(trajectory, self._sums.frames)
        window = self.window(self._sampler.any(self._sums.frames))
        if window is not None:
            self.step(*window, trajectory, free)

    def _optimise_online(self, trajectory: Trajectory) -> None:
        """Take some steps, half of them on the newest chunks; solve for brightness every few frames."""
        every = self._settings.solve_every
        if self._settings.solve_views and self._num_frames % every == every - 1:
            self.solve_brightness(trajectory, self._sums.frames)
        for _ in range(self._config.iterations):
            if self.budget.left(ONLINE_SHARE) <= 0:
                break
            window = self.window(self._sampler.recent(self._sums.frames))
            if window is not None:
                self.step(*window, trajectory, free=None)
        prune_faded(self.gaussians, self._config.min_opacity)

    # --- windows of events ---

    def window(self, index: int) -> tuple[Knot, Knot] | None:
        """Return a random window that ends in a frame's chunk; None where there are too few events.

        The number of its events is drawn on a logarithmic scale between the settings' bounds.
        """
        knots = [knot for k in self._sums.frames if k <= index for knot in self._sums.knots(k)]
        own = len(self._sums.knots(index))
        if not own or len(knots) < 2:
            return None
        last = len(knots) - 1 - int(self._random.integers(own))
        settings, pixels = self._settings, self._camera.width * self._camera.height
        low, high = math.log(settings.min_window), math.log(settings.max_window)
        wanted = pixels * math.exp(self._random.uniform(low, high))
        end = knots[last]
        first = bisect.bisect_right(knots, end.num_events - wanted, key=lambda knot: knot.num_events) - 1
        first = min(max(first, 0), last - 1)
        if first < 0:
            return None
        while first < last - 1 and end.time - knots[first].time > self._config.stretch:
            first += 1
        start = knots[first]
        is_usable = end.num_events - start.num_events > FEWEST_EVENTS * pixels * settings.min_window
        return (start, end) if is_usable and end.time - start.time <= self._config.stretch else None

    # --- steps ---

    def step(
        self,
        start: Knot,
        end: Knot,
        trajectory: Trajectory,
        free: range | None,  # frames whose poses may move; None: none
        level: int = 0,  # images are reduced by 2^level
    ) -> float:
        """Take one step of the loss between two renders; return the share of the change not explained."""
        self.num_steps += 1
        path = PathPoses(trajectory, (start.time, end.time), free)
        T, reduction = path.T_world_camera, Reduction.of(self._camera, level)
        chosen = torch.cat([drawable(self.gaussians, reduction.camera, pose) for pose in T]).unique()
        if len(chosen) == 0:
            return 1.0
        change = self._sums.change(start, end)
        subset = self.gaussians.subset(chosen)
        active = subset.activated()
        comparison = change_loss(
            active, T, change, reduction, self._config.background, self._config.log_epsilon
        )
        norm = comparison.loss.sqrt()  # Eq. 12, per pixel
        total = self._config.event_weight * norm + self._other_losses(subset, active, trajectory)
        total.backward()
        self._observe(subset, chosen, T[1].detach())
        subset.step()
        self.gaussians.update_from(subset, chosen)
        for index, gradient in path.gradients().items():
            self._refiner.step(index, gradient, trajectory)
        error = float(norm.detach())
        self.loss = error if math.isnan(self.loss) else 0.95 * self.loss + 0.05 * error
        return error**2 / max(float(reduction.reduced(change).square().mean()), 1e-12)

    def _other_losses(self, subset: GaussianMap, active: Gaussians, trajectory: Trajectory) -> Tensor:
        """Return what is added to the event loss: Eq. 14."""
        return self._config.scale_weight * scale_loss(subset.raw["log_scales"], self._config.max_scale_ratio)

    def _observe(self, subset: GaussianMap, chosen: Tensor, T_world_camera: Tensor) -> None:
        """See a step's gradients, for densification; the default does nothing."""

    def solve_brightness(self, trajectory: Trajectory, frames: Sequence[int]) -> None:
        """Correct all brightness at once (brightness_solve.py), from views spread over some frames."""
        knots = self._spread_knots(frames)
        if len(knots) < MIN_VIEWS:
            return
        views = [self._view(trajectory.at(knot.time)) for knot in knots]
        epsilon, iterations = self._config.log_epsilon, self._settings.solve_iterations
        solve_brightness(
            self.gaussians, views, self._pairs(knots, PAIR_STEPS), epsilon, WHITE_LEVEL, iterations
        )

    def solve_depth(self, trajectory: Trajectory, frames: Sequence[int], level: int, cell: float) -> None:
        """Move all Gaussians along their rays at once (depth_solve.py), on images reduced by 2^level.

        Those of a cell, `cell` radians wide, move together.
        """
        knots = self._spread_knots(frames)
        if len(knots) < MIN_VIEWS:
            return
        reduction = Reduction.of(self._camera, level)
        poses = [trajectory.at(knot.time) for knot in knots]
        seen = [
            SeenFrom(
                render_map(self.gaussians, reduction.camera, T, self._config.background),
                torch.from_numpy(inverse(T)).float(),
            )
            for T in poses
        ]
        epsilon, iterations = self._config.log_epsilon, self._settings.solve_iterations
        solve_depth(
            self.gaussians, seen, self._pairs(knots, NEAR_STEPS), reduction, epsilon, cell, iterations
        )

    def _spread_knots(self, frames: Sequence[int]) -> list[Knot]:
        """Return the last knots of at most `solve_views` frames, evenly spread."""
        knots = [self._sums.knots(k)[-1] for k in frames if self._sums.knots(k)]
        return [knots[k] for k in evenly(list(range(len(knots))), self._settings.solve_views)]

    def _pairs(self, knots: Sequence[Knot], gaps: Sequence[int]) -> list[Pair]:
        """Return the changes between knots that are some knots, and not too much time, apart."""
        return [
            Pair(k, k + gap, self._sums.change(knots[k], knots[k + gap]))
            for gap in gaps
            for k in range(len(knots) - gap)
            if knots[k + gap].time - knots[k].time <= self._config.stretch
        ]
