"""Building the Gaussian map from events and depth, poses refined with it (Sec. III-C to III-E)."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

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
from edslam_ti.mapping.gaussian_ply import write_gaussian_ply
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.insertion import new_gaussians
from edslam_ti.mapping.keyframes import Keyframe, covisibility, is_keyframe
from edslam_ti.mapping.losses import map_loss
from edslam_ti.mapping.mapper import Progress
from edslam_ti.mapping.poses import MapAligner, PoseMemory, PoseRefiner, StepPose
from edslam_ti.mapping.recolouring import recolour
from edslam_ti.mapping.rendering import RenderOutput, View, drawable, render_map, render_view
from edslam_ti.mapping.targets import EventImages, FrameSampler, evenly
from edslam_ti.trajectory import Trajectory

ONLINE_SHARE = 0.5  # of the budget, for the steps while the map grows
ADJUST_FROM = 0.3  # fraction of the final steps after which poses are adjusted, too
ALIGN_FROM = 0.5  # fraction of them after which frames without depth are aligned to the map, once
LAST_RATE = 0.05  # of the learning rates, to which they fall during the final steps
WHITE_LEVEL = 0.93  # brightness given to the brightest percent of pixels
SOLVE_EVERY = 5  # frames between solutions of the start image
MAX_RECOLOURED = 8  # frames looked at for the brightness that such a solution gives Gaussians
SETTLING = (0.002, 0.1)  # metres, degrees: poses that change by less are only being refined


class GaussianMapper:
    """Gaussians from depth, optimised with the poses for what events say has changed since the beginning.

    Eq. 10 to 12 with t_k at the beginning of a window of some seconds. The image there is unknown but the
    same for all frames of the window: it is solved (event_images/solve.py). A step then compares a single
    view with that image plus the change. Grey images, where given, are such views themselves and tell what
    the start is.
    """

    def __init__(
        self,
        camera: Camera,
        contrast: ContrastThreshold,
        config: Config,
        sharp_images: SharpImages | None = None,
    ) -> None:
        self.gaussians = GaussianMap(config.mapping)
        self.keyframes: list[Keyframe] = []
        self.images = EventImages(camera, contrast, config.mapping, sharp_images)
        self.budget = Budget(config.mapping.budget)
        self.loss = float("nan")  # running mean of the event loss
        self.num_steps = 0  # taken so far
        self._camera = camera
        self._config = config.mapping
        self._keyframe_config = config.keyframes
        self._random = np.random.default_rng(config.seed + 1)
        self._sampler = FrameSampler(self._random, config.keyframes.num_chunks)
        # Bundle adjustment refines tracked poses; true ones stay as they are.
        self._adjusts_poses = config.mapping.bundle_adjustment and config.poses == "tracked"
        self._refiner = PoseRefiner(config.mapping.poses_rate)
        self._aligner = MapAligner(camera, config.tracking, config.mapping)
        self._built_on = PoseMemory()
        self._num_frames = 0
        self._num_supervised = 0  # frames that the map has been optimised for, dropped ones too

    @property
    def num_gaussians(self) -> int:
        return len(self.gaussians)

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
        """Refine map and poses over everything kept, with falling learning rates."""
        self.budget.start()
        if len(self.gaussians) > 0 and self._solve_brightness(trajectory, is_thorough=True):
            self._optimise_finally(trajectory, progress)
            prune_faded(self.gaussians, self._config.min_opacity)
        self.budget.stop()

    def _optimise_online(self, trajectory: Trajectory) -> None:
        """Solve the start image now and then, and take a few steps, half of them on the newest frames."""
        self._num_supervised += 1
        count = self._num_supervised
        if count % SOLVE_EVERY == 0 or (count < SOLVE_EVERY and not self.images.is_solved):
            self._solve_brightness(trajectory)
        if self.images.is_solved:
            for _ in range(self._config.iterations):
                if self.budget.left(ONLINE_SHARE) <= 0:
                    break
                # A young map's errors would pull the poses along: they are adjusted to the finished one.
                index = self._sampler.recent(self.images.frames)
                difference = self._optimise(index, trajectory, adjusts_poses=False)
                if difference is not None:
                    self.images.learn_detail_from_render(index, difference)
        self.images.drop_surplus(keep={k.index for k in self.keyframes})
        prune_faded(self.gaussians, self._config.min_opacity)

    def _optimise_finally(self, trajectory: Trajectory, progress: Progress) -> None:
        """Take the final steps: the map first, then poses with it, and once those of frames without depth."""
        allowed, done, is_aligned = self.budget.left(), 0.0, not self._adjusts_poses
        densifier = self._densifier(trajectory) if self._config.densify else None
        for k in range(self._config.final_iterations):
            if done >= 1:
                break
            rate = LAST_RATE**done
            self.gaussians.decay_rates(rate)
            self._refiner.rate = self._config.poses_rate * rate
            if not is_aligned and done >= ALIGN_FROM:
                self._aligner.align(trajectory, self.images, self.gaussians)
                is_aligned = True
            adjusts_poses = self._adjusts_poses and done >= ADJUST_FROM
            index = self._sampler.any(self.images.frames)
            difference = self._optimise(index, trajectory, adjusts_poses, densifier)
            if difference is not None:
                self.images.learn_detail_from_render(index, difference)
            if densifier is not None:
                self._densify(densifier, k + 1)
            done = (k + 1) / self._config.final_iterations
            if allowed < math.inf:
                done = max(done, 1 - self.budget.left() / allowed) if allowed > 0 else 1.0
            if not progress(min(done, 1.0)):
                break

    # --- what the map shows ---

    def render(self, camera: Camera, T_world_camera: np.ndarray, measured_only: bool = False) -> View:
        """Return the map seen from a pose; `measured_only`: without Gaussians at assumed depth."""
        gaussians = self.gaussians.measured() if measured_only else self.gaussians
        return render_view(gaussians, camera, T_world_camera, self._config.background)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gaussians' centres and brightness."""
        with torch.no_grad():
            gaussians = self.gaussians.activated()
        return gaussians.means.detach().numpy(), gaussians.colors.numpy()[:, 0]

    @property
    def map(self) -> GaussianMap:
        """The Gaussians."""
        return self.gaussians

    def keyframe_indices(self) -> list[int]:
        """Return the frames chosen as keyframes."""
        return [keyframe.index for keyframe in self.keyframes]

    def metrics(self) -> dict[str, int | float | None]:
        """Return the numbers of keyframes, of steps taken, and of pixels that fire by themselves."""
        return {
            "num_keyframes": len(self.keyframes),
            "num_mapping_steps": self.num_steps,
            "num_hot_pixels": int(self.images.noisy_pixels.mask.sum()),
        }

    def save(self, folder: Path) -> None:
        """Write map.ply, the Gaussians in the layout of 3D Gaussian splatting."""
        raw = {name: value.detach().numpy() for name, value in self.gaussians.raw.items()}
        colors = self.gaussians.activated().colors.detach().numpy()
        write_gaussian_ply(
            folder / "map.ply",
            raw["means"],
            raw["quats"],
            raw["log_scales"],
            raw["logit_opacities"],
            colors,
        )

    def _view(self, T_world_camera: np.ndarray) -> RenderOutput:  # [4, 4]
        return render_map(self.gaussians, self._camera, T_world_camera, self._config.background)

    # --- growing ---

    def _move_with_corrected_poses(self, trajectory: Trajectory) -> None:
        """Deform the map as the poses that it was built from have been corrected.

        Images from events belong to frames and need not be moved.
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
        """Add Gaussians where the map does not show the frame's depth; make it a keyframe if much is new."""
        T, config = trajectory.pose(index), self._config
        view = self._view(T)
        if not self.keyframes or self._sees_enough_new(view, depth, index, trajectory):
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

    def _sees_enough_new(
        self, view: RenderOutput, depth: np.ndarray, index: int, trajectory: Trajectory
    ) -> bool:
        T_last, T_now = trajectory.pose(self.keyframes[-1].index), trajectory.pose(index)
        shared = covisibility(view.visible, self._view(T_last).visible)
        translation = float(np.linalg.norm(T_now[:3, 3] - T_last[:3, 3]))
        measured = depth[depth > 0]
        median_depth = float(np.median(measured)) if len(measured) else np.inf
        return is_keyframe(shared, translation, median_depth, self._keyframe_config)

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

    def _solve_brightness(self, trajectory: Trajectory, is_thorough: bool = False) -> bool:
        """Solve the start image and give the Gaussians its brightness; return whether it could be solved."""
        was_solved, epsilon = self.images.is_solved, self._config.log_epsilon
        newest = evenly(self.images.newest_frames, MAX_RECOLOURED)
        changed = self.images.frames if is_thorough or not was_solved else newest
        before = {k: self.images.log_brightness(k) for k in changed} if was_solved else {}
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

    def _optimise(
        self,
        index: int,  # of a frame
        trajectory: Trajectory,
        adjusts_poses: bool,
        densifier: Densifier | None = None,
    ) -> np.ndarray | None:  # [H, W]
        """Take one step of Eq. 16 on one frame, the map's and the pose's; tell the densifier about it.

        Return log brightness of the map less that of the image, None where the map is out of view.
        """
        self.num_steps += 1
        pose = StepPose(trajectory, index, adjusts_poses)
        T = pose.T_world_camera
        # What is out of view costs nothing, however large the map.
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
