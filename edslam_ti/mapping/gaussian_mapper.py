"""Builds the Gaussian map from events and depth, and refines poses with it (Sec. III-C to III-E)."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.event_images.sharp import SharpImages
from edslam_ti.frame import Frame
from edslam_ti.geometry import is_near
from edslam_ti.mapping.budget import Budget, prune_faded
from edslam_ti.mapping.densification import Densifier, scene_size
from edslam_ti.mapping.insertion import new_gaussians
from edslam_ti.mapping.keyframes import Keyframe
from edslam_ti.mapping.losses import map_loss
from edslam_ti.mapping.mapper import Progress
from edslam_ti.mapping.poses import MapAligner, PoseMemory, PoseRefiner, StepPose
from edslam_ti.mapping.recolouring import recolour
from edslam_ti.mapping.rendering import drawable
from edslam_ti.mapping.shown_map import ShownMap
from edslam_ti.mapping.targets import EventImages, FrameSampler, evenly
from edslam_ti.trajectory import Trajectory

ONLINE_SHARE = 0.5  # share of the budget for the steps during the run
ADJUST_FROM = 0.3  # fraction of the final steps after which poses are optimised, too
ALIGN_FROM = 0.5  # fraction of the final steps after which frames without depth are aligned to the map, once
LAST_RATE = 0.05  # learning rates fall to this share of their values during the final steps
WHITE_LEVEL = 0.93  # brightness given to the brightest percent of pixels
SOLVE_EVERY = 5  # frames between two solves of the start image
MAX_RECOLOURED = 8  # after each solve, Gaussians are recoloured from at most this many frames
LEAST_ALPHA = 0.8  # where the map shows a surface
SETTLING = (0.002, 0.1)  # metres, degrees: the map does not follow smaller changes of poses


@dataclass
class Refinement:
    """How far the final steps are."""

    allowed: float  # seconds of the budget when they began
    densifier: Densifier | None
    is_aligned: bool  # frames without depth need no alignment to the map any more
    num_steps: int = 0
    done: float = 0.0  # share of the final steps, or of the budget


class GaussianMapper(ShownMap):
    """Places Gaussians at measured depth and optimises them, and the poses, to explain the events.

    Eq. 10 to 12 with t_k at the beginning of a window of some seconds. The image at t_k is unknown but the
    same for all frames of the window, so it is solved once (event_images/solve.py). A step then compares a
    single view with that image plus the change since t_k. Grey images, where given, serve as such views and
    fix the image at t_k.
    """

    def __init__(
        self,
        camera: Camera,
        contrast: ContrastThreshold,
        config: Config,
        sharp_images: SharpImages | None = None,
    ) -> None:
        super().__init__(camera, config)
        self.keyframes: list[Keyframe] = []
        self.images = EventImages(camera, contrast, config.mapping, sharp_images)
        self.budget = Budget(config.mapping.budget)
        self.loss = float("nan")  # running mean of the event loss
        self.num_steps = 0  # taken so far
        self._random = np.random.default_rng(config.seed + 1)
        self._sampler = FrameSampler(self._random, config.keyframes.num_chunks)
        # Bundle adjustment refines tracked poses; true ones stay as they are.
        self._adjusts_poses = config.mapping.bundle_adjustment and config.poses == "tracked"
        self._refiner = PoseRefiner(config.mapping.poses_rate)
        self._aligner = MapAligner(camera, config.tracking, config.mapping)
        self._built_on = PoseMemory()
        self._refinement: Refinement | None = None  # None: not refining
        self._num_frames = 0
        self._num_supervised = 0  # frames that the map has been optimised for, including dropped ones

    # --- the loop ---

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Add the frame's events and Gaussians, then optimise over the window."""
        self.budget.start(frame.timestamp)
        self._move_with_corrected_poses(trajectory)
        index = self._num_frames
        self._num_frames += 1
        self.images.add(frame, index)
        if frame.depth is not None and not frame.is_held_out:
            self._add_depth(frame.depth, index, trajectory)
        if not frame.is_held_out and len(self.gaussians) > 0:
            self._optimise_online(trajectory)
        self._built_on.remember(trajectory)
        self.budget.stop()

    def forget_depth(self, frames: Sequence[int], trajectory: Trajectory) -> None:
        """Remove the Gaussians from the depth of some frames, and fill the gaps from that of the others."""
        self.gaussians.remove_frames(frames)
        self.images.forget_depth(frames)
        self.keyframes = [k for k in self.keyframes if k.index not in frames]
        for k in self.images.frames:
            depth = self.images.depth(k)
            if depth is not None:
                self._add_depth(depth, k, trajectory)

    def finish(self, trajectory: Trajectory, progress: Progress) -> None:
        """Refine map and poses over everything kept, with falling learning rates.

        A mapper restored from its state in mid refinement goes on with the next step.
        """
        self.budget.start()
        if self._refinement is None:
            self._refinement = self._begin_refinement(trajectory)
        if self._refinement is not None:
            self._optimise_finally(self._refinement, trajectory, progress)
            prune_faded(self.gaussians, self._config.min_opacity)
        self._refinement = None
        self.budget.stop()

    def _begin_refinement(self, trajectory: Trajectory) -> Refinement | None:
        """Solve all start images; return where the final steps begin, None where nothing can be refined."""
        if len(self.gaussians) == 0 or not self._solve_brightness(trajectory, is_thorough=True):
            return None
        for _ in range(self._config.compare_pixels):
            if not self._solve_brightness(trajectory, is_thorough=True, compares_pixels=True):
                break
        allowed = self.budget.left()
        densifier = self._densifier(trajectory) if self._config.densify else None
        return Refinement(allowed, densifier, is_aligned=not self._adjusts_poses)

    def _optimise_online(self, trajectory: Trajectory) -> None:
        """Solve the start image every few frames, and take some steps, half of them on the newest frames."""
        self._num_supervised += 1
        count = self._num_supervised
        if count % SOLVE_EVERY == 0 or (count < SOLVE_EVERY and not self.images.is_solved):
            self._solve_brightness(trajectory)
        if self.images.is_solved:
            for _ in range(self._config.iterations):
                if self.budget.left(ONLINE_SHARE) <= 0:
                    break
                # Errors of the unfinished map would spoil the poses; `finish` optimises them.
                index = self._sampler.recent(self.images.frames)
                difference = self._optimise(index, trajectory, adjusts_poses=False)
                if difference is not None:
                    self.images.learn_detail_from_render(index, difference)
        self.images.drop_surplus(keep={k.index for k in self.keyframes})
        prune_faded(self.gaussians, self._config.min_opacity)

    def _optimise_finally(self, state: Refinement, trajectory: Trajectory, progress: Progress) -> None:
        """Take the final steps: the map first, then poses with it, and once those of frames without depth."""
        while state.num_steps < self._config.final_iterations and state.done < 1:
            rate = LAST_RATE**state.done
            self.gaussians.decay_rates(rate)
            self._refiner.rate = self._config.poses_rate * rate
            if not state.is_aligned and state.done >= ALIGN_FROM:
                self._aligner.align(trajectory, self.images, self.gaussians)
                state.is_aligned = True
            adjusts_poses = self._adjusts_poses and state.done >= ADJUST_FROM
            index = self._sampler.any(self.images.frames)
            difference = self._optimise(index, trajectory, adjusts_poses, state.densifier)
            if difference is not None:
                self.images.learn_detail_from_render(index, difference)
            state.num_steps += 1
            if state.densifier is not None:
                self._densify(state.densifier, state.num_steps)
            state.done = state.num_steps / self._config.final_iterations
            if state.allowed < math.inf:
                left = self.budget.left() / state.allowed if state.allowed > 0 else 0.0
                state.done = max(state.done, 1 - left)
            if not progress(min(state.done, 1.0)):
                break

    # --- what the map shows ---

    def keyframe_indices(self) -> list[int]:
        """Return the frames chosen as keyframes."""
        return [keyframe.index for keyframe in self.keyframes]

    def metrics(self) -> dict[str, int | float | None]:
        """Return the numbers of keyframes, of optimisation steps, and of noisy pixels."""
        return {
            "num_keyframes": len(self.keyframes),
            "num_mapping_steps": self.num_steps,
            "num_hot_pixels": int(self.images.noisy_pixels.mask.sum()),
        }

    # --- growing ---

    def _move_with_corrected_poses(self, trajectory: Trajectory) -> None:
        """Move the Gaussians with the corrected poses of the frames that they came from.

        Event images belong to frames and need not be moved.
        """
        corrections = self._built_on.corrections(trajectory)
        if any(not is_near(T, *SETTLING) for T in corrections.values()):
            self.gaussians.move_with_frames(corrections)

    def _add_depth(
        self,
        depth: np.ndarray,  # [H, W] metres, 0 = missing
        index: int,  # of its frame
        trajectory: Trajectory,
    ) -> None:
        """Add Gaussians where the map lacks the frame's depth; add a keyframe if it sees enough new."""
        T, config = trajectory.pose(index), self._config
        view = self._view(T)
        last = trajectory.pose(self.keyframes[-1].index) if self.keyframes else None
        if last is None or self._sees_enough_new(view, depth, T, last):
            self.keyframes.append(Keyframe(index))
        alpha, rendered_depth = view.alpha.numpy(), view.expected_depth.numpy()
        new = new_gaussians(depth, alpha, rendered_depth, self._camera, T, len(self.gaussians), config)
        if new is None:
            return
        x, y = new.pixels.T
        if self.images.is_solved:
            brightness = np.exp(self.images.log_brightness(index)[y, x]) - config.log_epsilon
        else:
            brightness = np.full(len(new.means), config.background)
        self.gaussians.add(
            torch.from_numpy(new.means),
            torch.from_numpy(new.quats),
            torch.from_numpy(new.scales),
            config.initial_opacity,
            torch.from_numpy(brightness.astype(np.float32))[:, None],
            index,
            torch.from_numpy(new.is_measured),
        )

    def _densifier(self, trajectory: Trajectory) -> Densifier:
        config, size = self._config, scene_size(self.gaussians, trajectory.poses[:, :3, 3])
        seed = int(self._random.integers(1 << 31))
        return Densifier(self._camera, size, config.densify_gradient, config.max_gaussians, seed)

    def _densify(self, densifier: Densifier, step: int) -> None:
        config = self._config
        if step % config.densify_every == 0 and step <= config.final_iterations // 2:
            densifier.refine(self.gaussians)
        if step % config.opacity_reset_every == 0:
            densifier.reset_opacities(self.gaussians)

    # --- optimising ---

    def _solve_brightness(
        self, trajectory: Trajectory, is_thorough: bool = False, compares_pixels: bool = False
    ) -> bool:
        """Solve the start image and recolour the Gaussians; return whether the solve succeeded.

        `compares_pixels`: find each pixel's thresholds first; nothing to do where pixels are alike.
        """
        was_solved, epsilon = self.images.is_solved, self._config.log_epsilon
        newest = evenly(self.images.newest_frames, MAX_RECOLOURED)
        changed = self.images.frames if is_thorough or not was_solved else newest
        if not changed:  # a window has just begun, and no frame of it is kept so far
            return was_solved
        before = {k: self.images.log_brightness(k) for k in changed} if was_solved else {}
        if compares_pixels and not self._compare_pixels(trajectory):
            return False
        if not self.images.solve(trajectory, is_thorough):
            return False
        if is_thorough or not was_solved:
            self.images.set_white_level(WHITE_LEVEL)

        def views() -> Iterator[tuple[np.ndarray, np.ndarray]]:
            for k in changed:
                view = self._view(trajectory.pose(k))
                old = before[k] if k in before else np.log(view.intensity.numpy() + epsilon)
                yield view.dominant.numpy(), self.images.log_brightness(k) - old

        recolour(self.gaussians, views(), changed[0] <= self.images.frames[0], epsilon)
        return True

    def _compare_pixels(self, trajectory: Trajectory) -> bool:
        """Compare the events of each pixel with what the map shows; return whether pixels differ."""

        def shown() -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
            for k in self.images.frames:
                view = self._view(trajectory.pose(k))
                log_brightness = np.log(view.intensity.numpy() + np.float32(self._config.log_epsilon))
                yield k, log_brightness, view.alpha.numpy() > LEAST_ALPHA

        return self.images.compare(shown())

    def _optimise(
        self,
        index: int,  # of a frame
        trajectory: Trajectory,
        adjusts_poses: bool,
        densifier: Densifier | None = None,
    ) -> np.ndarray | None:  # [H, W]
        """Take one step of Eq. 16 on one frame, for map and pose; the densifier observes the gradients.

        Return the map's log brightness minus the image's; None if the view shows no Gaussian.
        """
        self.num_steps += 1
        pose = StepPose(trajectory, index, adjusts_poses)
        T = pose.T_world_camera
        # Only Gaussians in view cost time, however large the map.
        chosen = drawable(self.gaussians, self._camera, T)
        if len(chosen) == 0:
            return None
        subset, measured = self.gaussians.subset(chosen), self.images.depth(index)
        depth = None if measured is None else torch.from_numpy(measured)
        target = torch.from_numpy(self.images.log_brightness(index))
        loss = map_loss(subset, self._camera, T, target, depth, self._config)
        loss.total.backward()
        if densifier is not None and (pull := subset.raw["means"].grad) is not None:
            densifier.observe(len(self.gaussians), chosen, subset.raw["means"].detach(), pull, T)
        subset.step()
        self.gaussians.update_from(subset, chosen)
        if (gradient := pose.gradient) is not None:
            self._refiner.step(index, gradient, trajectory)
        self.loss = loss.event if np.isnan(self.loss) else 0.95 * self.loss + 0.05 * loss.event
        return loss.difference
