"""Building the Gaussian map from events and depth, poses refined with it (Sec. III-C to III-E)."""

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.event_images.sharp import SharpImages
from edslam_ti.frame import Frame
from edslam_ti.geometry import is_near, orthonormalized, se3_exp
from edslam_ti.mapping.densification import Densifier
from edslam_ti.mapping.gaussian_ply import write_gaussian_ply
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.insertion import beside_steps, depth_to_points, surface_discs, with_holes_filled
from edslam_ti.mapping.keyframes import Keyframe, is_keyframe
from edslam_ti.mapping.losses import scale_loss, view_loss
from edslam_ti.mapping.mapper import Progress
from edslam_ti.mapping.poses import MapAligner
from edslam_ti.mapping.rendering import RenderOutput, View, drawable, render, render_view
from edslam_ti.mapping.targets import EventImages, evenly
from edslam_ti.trajectory import Trajectory

ONLINE_SHARE = 0.5  # of the budget, for the steps while the map grows
ADJUST_FROM = 0.3  # fraction of the final steps after which poses are adjusted, too
ALIGN_FROM = 0.5  # fraction of them after which frames without depth are aligned to the map, once
WHITE = 0.93  # brightness given to the brightest percent of pixels
SOLVE_EVERY = 5  # frames between solutions of the start image
MAX_RECOLOURED = 8  # frames looked at for the brightness that such a solution gives Gaussians
FINER = 2  # times closer are new Gaussians beside steps of depth
FLATNESS = 0.2  # thickness of a new Gaussian, as a share of its width
MAX_STRETCH = 4.0  # of a new Gaussian on a surface that falls away
SETTLING = (0.002, 0.1)  # metres, degrees: poses that change by less are only being refined
EVENT_VARIANCE = 0.1  # squared log brightness: scale of the event loss


class PoseRefiner:
    """Adam on twists of individual poses: T <- T exp(step), moments kept per frame."""

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self._first: dict[int, np.ndarray] = {}
        self._second: dict[int, np.ndarray] = {}
        self._count: dict[int, int] = {}

    def step(self, index: int, gradient: np.ndarray, trajectory: Trajectory) -> None:
        """Move pose `index` of the trajectory against the gradient [6] of its twist."""
        n = self._count[index] = self._count.get(index, 0) + 1
        first = self._first[index] = 0.9 * self._first.get(index, 0.0) + 0.1 * gradient
        second = self._second[index] = 0.99 * self._second.get(index, 0.0) + 0.01 * gradient**2
        update = -self.rate * (first / (1 - 0.9**n)) / (np.sqrt(second / (1 - 0.99**n)) + 1e-12)
        moved = trajectory.pose(index) @ se3_exp(torch.from_numpy(update)).numpy()
        trajectory.replace(index, orthonormalized(moved))


class _Poses:
    """Differentiable poses of one optimisation step: T_k exp(delta_k), all deltas zero."""

    def __init__(self, trajectory: Trajectory, is_free: bool) -> None:
        self._trajectory = trajectory
        self._is_free = is_free
        self.deltas: dict[int, Tensor] = {}

    def of_frame(self, index: int) -> Tensor:  # [4, 4]
        """Return the pose of a frame; the first frame's is fixed, it is the gauge."""
        pose = torch.from_numpy(self._trajectory.pose(index))
        if not self._is_free or index == 0:
            return pose
        if index not in self.deltas:
            self.deltas[index] = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        return pose @ se3_exp(self.deltas[index])


class Budget:
    """Seconds of computing that mapping may take, growing with the seconds of data taken in."""

    def __init__(self, seconds_per_second: float | None) -> None:
        self.spent = 0.0  # seconds
        self._rate = seconds_per_second
        self._first = self._last = float("nan")  # seconds of data
        self._started: float | None = None  # None: not counting

    def start(self, timestamp: float | None = None) -> None:
        """Begin to count, with data up to a time stamp."""
        self._started = time.perf_counter()
        if timestamp is not None:
            self._first = timestamp if math.isnan(self._first) else self._first
            self._last = timestamp

    def stop(self) -> None:
        """Stop counting."""
        self.spent, self._started = self._now(), None

    def left(self, share: float = 1.0) -> float:
        """Return how many seconds are left of a share of all that the data so far allows; below 0: none."""
        if self._rate is None:
            return math.inf
        return share * self._rate * (self._last - self._first) - self._now()

    def _now(self) -> float:
        return self.spent + (0.0 if self._started is None else time.perf_counter() - self._started)


class GaussianMapper:
    """Gaussians from depth, optimised with the poses for what events say has changed since the beginning.

    Eq. 10 to 12 with t_k at the beginning of the stretch, where the image is unknown but the same for all its
    frames: it is solved (brightness.py), and a step then compares a single view with start + change. Grey
    images, where given, are such views themselves and tell what the start is.
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
        self.loss = float("nan")
        self._camera = camera
        self._config = config.mapping
        self._keyframe_config = config.keyframes
        self._random = np.random.default_rng(config.seed + 1)
        self.images = EventImages(camera, contrast, config.mapping, sharp_images)
        self._order: list[int] = []  # frames still to come in this round of steps
        # Bundle adjustment refines tracked poses; true ones stay as they are.
        self._adjusts_poses = config.mapping.bundle_adjustment and config.poses == "tracked"
        self._refiner = PoseRefiner(config.mapping.poses_rate)
        self._aligner = MapAligner(camera, config.tracking)
        self._num_frames = 0
        self._num_supervised = 0  # frames that the map has been optimised for, forgotten ones too
        self.budget = Budget(config.mapping.budget)
        self.num_steps = 0  # taken so far

    @property
    def num_gaussians(self) -> int:
        return len(self.gaussians)

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Add the frame's events and Gaussians, then optimise over the window."""
        self.budget.start(frame.timestamp)
        self._update(frame, trajectory)
        self.budget.stop()

    def finish(self, trajectory: Trajectory, progress: Progress) -> None:
        """Refine map and poses over everything kept, with falling learning rates."""
        self.budget.start()
        self._finish(trajectory, progress)
        self.budget.stop()

    def _update(self, frame: Frame, trajectory: Trajectory) -> None:
        index = self._num_frames
        self._num_frames += 1
        self._follow(trajectory)
        self.images.append(frame, index)
        if frame.depth is not None and not frame.is_held_out:
            self._take_in_depth(frame, index, trajectory)
        if frame.is_held_out or len(self.gaussians) == 0:
            return
        self._num_supervised += 1
        count = self._num_supervised
        if count % SOLVE_EVERY == 0 or (count < SOLVE_EVERY and not self.images.is_solved):
            self._solve_brightness(trajectory)
        if self.images.is_solved:
            for _ in range(self._config.iterations):
                if self.budget.left(ONLINE_SHARE) <= 0:
                    break
                # A young map's errors would pull the poses along: they are adjusted to the finished one.
                self._optimise(self._draw_recent(), trajectory, adjusts_poses=False)
        self.images.thin_out(keep={k.index for k in self.keyframes})
        self._prune()

    def _finish(self, trajectory: Trajectory, progress: Progress) -> None:
        if len(self.gaussians) == 0 or not self._solve_brightness(trajectory, is_thorough=True):
            return
        allowed, done, is_aligned = self.budget.left(), 0.0, not self._adjusts_poses
        densifier = self._densifier(trajectory) if self._config.densify else None
        for k in range(self._config.final_iterations):
            if done >= 1:
                break
            rate = 0.05**done  # ends at a twentieth
            self.gaussians.decay_rates(rate)
            self._refiner.rate = self._config.poses_rate * rate
            if not is_aligned and done >= ALIGN_FROM:
                self._align(trajectory)
                is_aligned = True
            adjusts_poses = self._adjusts_poses and done >= ADJUST_FROM
            self._optimise(self._draw_any(), trajectory, adjusts_poses, densifier)
            if densifier is not None:
                self._densify(densifier, k + 1)
            done = (k + 1) / self._config.final_iterations
            if allowed < math.inf:
                done = max(done, 1 - self.budget.left() / allowed) if allowed > 0 else 1.0
            if not progress(min(done, 1.0)):
                break
        self._prune()

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
            "num_hot_pixels": int(self.images.hot.sum()),
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

    # --- growing ---

    def _follow(self, trajectory: Trajectory) -> None:
        """Deform the map as the tracker has corrected the poses that it was built from.

        Images from events belong to frames and need not be moved.
        """
        corrections = trajectory.take_corrections()
        if any(not is_near(T, *SETTLING) for T in corrections.values()):
            self.gaussians.follow(corrections)

    def _take_in_depth(self, frame: Frame, index: int, trajectory: Trajectory) -> None:
        assert frame.depth is not None
        T = trajectory.pose(index)
        candidate = Keyframe(index, frame.timestamp)
        view = self._render(T)
        if not self.keyframes or self._is_keyframe(candidate, frame.depth, view.visible, trajectory):
            self.keyframes.append(candidate)
        self._add_gaussians(index, frame.depth, T, view)

    def _is_keyframe(
        self,
        frame: Keyframe,
        depth: np.ndarray,  # [H, W] metres, 0 = missing
        visible: Tensor,  # [N] bool
        trajectory: Trajectory,
    ) -> bool:
        last = self.keyframes[-1]
        T_last, T_now = trajectory.pose(last.index), trajectory.pose(frame.index)
        seen = self._render(T_last).visible
        union = int((visible | seen).sum())
        covisibility = int((visible & seen).sum()) / max(union, 1)
        translation = float(np.linalg.norm(T_now[:3, 3] - T_last[:3, 3]))
        measured = depth[depth > 0]
        median_depth = float(np.median(measured)) if len(measured) else np.inf
        return is_keyframe(covisibility, translation, median_depth, self._keyframe_config)

    def _add_gaussians(
        self,
        index: int,  # of the frame
        depth: np.ndarray,  # [H, W] metres, 0 = missing
        T_world_camera: np.ndarray,  # [4, 4]
        view: RenderOutput,
    ) -> None:
        """Add Gaussians at the pixels that Eq. 13 selects, one per stride x stride block, closer at outlines.

        So are pixels without depth where the map shows nothing, at the depth that is assumed there.
        """
        config = self._config
        alpha = view.alpha.numpy()
        mask = densify_mask(
            alpha, view.expected_depth.numpy(), depth, config.min_visibility, config.depth_error_factor
        )
        mask |= (depth <= 0) & (alpha < config.min_visibility)
        is_measured, depth = depth > 0, with_holes_filled(depth)
        s = stride_in_room(config.pixel_stride, len(self.gaussians) / config.max_gaussians)
        spacing = np.where(beside_steps(depth), max(s // FINER, 1), s)
        points, pixels = depth_to_points(depth, self._camera, T_world_camera, mask & spaced(spacing))
        room = config.max_gaussians - len(self.gaussians)
        points, pixels = points[:room], pixels[:room]
        if len(points) == 0:
            return
        x, y = pixels[:, 0], pixels[:, 1]
        # Discs on the surface; small ones sharpen faster than large ones shrink, and Eq. 13 fills the gaps.
        size = config.initial_size * spacing[y, x] * depth[y, x] / self._camera.fx
        quats, stretch = surface_discs(depth, self._camera, T_world_camera, pixels, MAX_STRETCH)
        scales = size[:, None] * np.stack([np.ones_like(size), stretch, np.full_like(size, FLATNESS)], 1)
        if self.images.is_solved:
            brightness = np.exp(self.images.log_brightness(index)[y, x]) - config.log_epsilon
        else:
            brightness = np.full(len(points), config.background)
        self.gaussians.add(
            torch.from_numpy(points.astype(np.float32)),
            torch.from_numpy(quats),
            torch.from_numpy(scales.astype(np.float32)),
            config.initial_opacity,
            torch.from_numpy(brightness.astype(np.float32))[:, None],
            index,
            torch.from_numpy(is_measured[y, x]),
        )

    def _densifier(self, trajectory: Trajectory) -> Densifier:
        positions = trajectory.poses[:, :3, 3]
        means = self.gaussians.raw["means"].detach().numpy()
        size = float(np.median(np.linalg.norm(means - positions.mean(0), axis=1)))
        config = self._config
        seed = int(self._random.integers(1 << 31))
        return Densifier(self._camera, size, config.densify_gradient, config.max_gaussians, seed)

    def _densify(self, densifier: Densifier, step: int) -> None:
        config = self._config
        if step % config.densify_every == 0 and step <= config.final_iterations // 2:
            densifier.refine(self.gaussians)
        if step % config.opacity_reset_every == 0:
            densifier.reset_opacities(self.gaussians)

    def _prune(self) -> None:
        """Remove Gaussians that have faded."""
        keep = self.gaussians.raw["logit_opacities"].detach().sigmoid() > self._config.min_opacity
        if not bool(keep.all()):
            self.gaussians.keep(keep)

    # --- optimising ---

    def _solve_brightness(self, trajectory: Trajectory, is_thorough: bool = False) -> bool:
        """Solve the start image, and give the Gaussians the brightness of the images; whether it worked."""
        was_solved = self.images.is_solved
        newest = evenly(self.images.newest_frames, MAX_RECOLOURED)
        changed = self.images.frames if is_thorough or not was_solved else newest
        before = {k: self.images.log_brightness(k) for k in changed} if was_solved else {}
        if not self.images.solve(trajectory, is_thorough):
            return False
        if is_thorough or not was_solved:
            self.images.set_white(WHITE)
        self._recolour(trajectory, changed, before)
        return True

    def _recolour(self, trajectory: Trajectory, frames: list[int], before: dict[int, np.ndarray]) -> None:
        """Change every Gaussian's log brightness as the images of the frames have changed where it is seen.

        Gaussians that no image shows change as all others do on average, if all images have changed.
        """
        n = len(self.gaussians)
        total, count = np.zeros(n), np.zeros(n)
        epsilon = self._config.log_epsilon
        for k in frames:
            view = self._render(trajectory.pose(k))
            seen = view.dominant.numpy().ravel()
            old = before[k] if k in before else np.log(view.intensity.numpy() + epsilon)
            change = (self.images.log_brightness(k) - old).ravel()
            drawn = seen >= 0
            total += np.bincount(seen[drawn], change[drawn], n)
            count += np.bincount(seen[drawn], minlength=n)
        if count.any():
            everywhere = total.sum() / count.sum() if frames[0] <= self.images.frames[0] else 0.0
            change = np.where(count > 0, total / np.maximum(count, 1), everywhere)
            level = np.log(self.points()[1] + epsilon) + change
            self.gaussians.set_colors(torch.from_numpy((np.exp(level) - epsilon).astype(np.float32))[:, None])

    def _optimise(
        self,
        index: int,
        trajectory: Trajectory,
        adjusts_poses: bool,
        densifier: Densifier | None = None,
    ) -> None:
        """One step of Eq. 16 on one frame."""
        self.num_steps += 1
        config = self._config
        poses = _Poses(trajectory, adjusts_poses)
        T = poses.of_frame(index)
        # What is out of view costs nothing, however large the map.
        chosen = drawable(self.gaussians, self._camera, T)
        if len(chosen) == 0:
            return
        part = self.gaussians.part(chosen)
        measured = self.images.depth(index)
        view = view_loss(
            part.activated(),
            self._camera,
            T,
            torch.from_numpy(self.images.log_brightness(index)),
            None if measured is None else torch.from_numpy(measured),
            config.background,
            config.log_epsilon,
            (config.event_weight / EVENT_VARIANCE, config.depth_weight),
        )
        self.images.take_over_details(index, view.difference.numpy())
        loss = view.loss
        if config.scale_weight > 0:
            log_scales = part.raw["log_scales"]
            loss = loss + config.scale_weight * scale_loss(log_scales, config.max_scale_ratio)
        loss.backward()
        if densifier is not None and (pull := part.raw["means"].grad) is not None:
            densifier.observe(len(self.gaussians), chosen, part.raw["means"].detach(), pull, T)
        part.step()
        self.gaussians.take_over(part, chosen)
        for frame, delta in poses.deltas.items():
            if delta.grad is not None:
                self._refiner.step(frame, delta.grad.numpy(), trajectory)
        value = float(view.difference.square().mean()) / EVENT_VARIANCE
        self.loss = value if np.isnan(self.loss) else 0.95 * self.loss + 0.05 * value

    def _align(self, trajectory: Trajectory) -> None:
        """Correct the poses of frames without depth by the map."""
        for k in self.images.frames:
            if self.images.depth(k) is None:
                T = trajectory.pose(k)
                view = self._render(T)
                seen = np.log(view.intensity.numpy() + self._config.log_epsilon)
                depth, alpha = view.expected_depth.numpy(), view.alpha.numpy()
                image = self.images.log_brightness(k)
                trajectory.replace(k, self._aligner.corrected(image, seen, depth, alpha, T))

    @torch.no_grad()
    def _render(self, T_world_camera: np.ndarray) -> RenderOutput:  # [4, 4]
        """Return the map seen from a pose; what is out of view takes neither time nor memory."""
        T = torch.from_numpy(T_world_camera)
        chosen = drawable(self.gaussians, self._camera, T)
        view = render(self.gaussians.activated(chosen), self._camera, T, self._config.background)
        visible = torch.zeros(len(self.gaussians), dtype=torch.bool)
        visible[chosen] = view.visible
        # Indices of the part to those of the map; -1, the last one here, stays -1.
        of_map = torch.cat([chosen, torch.tensor([-1])]).int()
        return replace(view, visible=visible, dominant=of_map[view.dominant.long()])

    def _draw_recent(self) -> int:
        """Draw a frame, half of the time one of the newest."""
        frames = self.images.frames
        window = frames[-self._keyframe_config.num_chunks :] if self._random.random() < 0.5 else frames
        return window[int(self._random.integers(len(window)))]

    def _draw_any(self) -> int:
        """Draw a frame, each once before any comes again."""
        if not self._order:
            self._order = list(self._random.permutation(self.images.frames))
        return int(self._order.pop())


def stride_in_room(
    stride: int,  # pixels, in an empty map
    fullness: float,  # share of the largest number of Gaussians that there is
) -> int:
    """Return the spacing of new Gaussians: beyond half of the map's room, the fuller the coarser.

    A map that is full could not take in new surfaces at all.
    """
    room = min(1.0, 2 * (1 - fullness))
    return math.ceil(stride / math.sqrt(max(room, 1e-3)))


def spaced(
    spacing: np.ndarray,  # [H, W] int, pixels
) -> np.ndarray:  # [H, W] bool
    """Return one pixel of every block that is as wide and high as the spacing."""
    y, x = np.ogrid[: spacing.shape[0], : spacing.shape[1]]
    return (y % spacing == spacing // 2) & (x % spacing == spacing // 2)


def densify_mask(
    alpha: np.ndarray,  # [H, W] rendered
    rendered_depth: np.ndarray,  # [H, W] metres
    depth: np.ndarray,  # [H, W] metres, 0 = missing
    min_visibility: float,  # lambda_V
    depth_error_factor: float,  # lambda_MDE
) -> np.ndarray:  # [H, W] bool
    """Return the pixels where new Gaussians are needed and can be placed, Eq. 13."""
    valid = depth > 0
    if not valid.any():
        return valid
    error = np.abs(rendered_depth - depth)
    seen = valid & (alpha >= min_visibility)
    median_error = float(np.median(error[seen])) if seen.any() else np.inf
    return valid & ((alpha < min_visibility) | (error > depth_error_factor * median_error))
