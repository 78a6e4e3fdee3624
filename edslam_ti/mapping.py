"""Building the Gaussian map from events and depth, poses refined with it (Sec. III-C to III-E)."""

from collections.abc import Callable
from typing import Protocol

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from edslam_ti.brightness import solve_log_brightness
from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.frame import Frame
from edslam_ti.gaussians import GaussianMap, Gaussians
from edslam_ti.geometry import interpolate, orthonormalized, se3_exp
from edslam_ti.keyframes import EventArchive, Keyframe, is_keyframe
from edslam_ti.losses import brightness_change, depth_loss, event_loss, scale_loss
from edslam_ti.pointcloud import depth_to_points
from edslam_ti.rendering import RenderOutput, View, render, render_view
from edslam_ti.trajectory import Trajectory

Progress = Callable[[float], bool]  # told the fraction done, 0 to 1; False asks to stop

REDUCTION = 2  # of the images in reduced steps: pyramid level 1
ADJUST_FROM = 0.3  # fraction of the final steps after which poses are adjusted, too
WHITE = 0.9  # brightness given to the brightest percent of pixels
MAX_SOLVED = 60  # frames in the least-squares solution for brightness
MIN_CHUNKS = 3  # events of so many chunks are needed before the map's brightness can be optimised
HELD_OUT_MARGIN = 0.15  # fraction of a chunk around a held-out time where no interval may begin or end


class Mapper(Protocol):
    """Builds a map from tracked frames and shows it."""

    @property
    def num_gaussians(self) -> int:
        """Size of the map; 0 for maps of another kind."""

    @property
    def loss(self) -> float:
        """Running mean of what is minimised; nan where nothing is."""

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Take in the newest frame, whose pose ends the trajectory; may correct earlier poses."""

    def finish(self, trajectory: Trajectory, progress: Progress) -> None:
        """Last refinement after the last frame; may correct poses."""

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> View:
        """Return the map seen from a pose [4, 4]."""

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return points [N, 3] (metres, world) and their brightness [N] in [0, 1]."""


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

    def within(self, chunk: int, fraction: float) -> Tensor:  # [4, 4]
        """Return the pose inside the chunk between frames `chunk` and `chunk` + 1, Eq. 9."""
        if fraction == 0:
            return self.of_frame(chunk)
        return interpolate(self.of_frame(chunk), self.of_frame(chunk + 1), fraction)


class GaussianMapper:
    """Gaussians from depth, optimised over random event intervals with the poses (Eq. 9-16)."""

    def __init__(self, camera: Camera, contrast_threshold: float, config: Config) -> None:
        self.gaussians = GaussianMap(config.mapping)
        self.keyframes: list[Keyframe] = []
        self.loss = float("nan")
        self._camera = camera
        self._contrast_threshold = contrast_threshold
        self._config = config.mapping
        self._keyframe_config = config.keyframes
        self._random = np.random.default_rng(config.seed + 1)
        self._archive = EventArchive(camera.shape, config.mapping.bins_per_chunk)
        self._held_out: set[int] = set()
        self._recent: list[Keyframe] = []  # the last frames with depth, whether keyframes or not
        # Bundle adjustment refines tracked poses; true ones stay as they are.
        self._adjusts_poses = config.mapping.bundle_adjustment and config.poses == "tracked"
        self._refiner = PoseRefiner(config.mapping.poses_rate)
        self._num_frames = 0
        self._num_steps = 0

    @property
    def num_gaussians(self) -> int:
        return len(self.gaussians)

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Add the frame's events and Gaussians, then optimise over the window."""
        index = self._num_frames
        self._num_frames += 1
        if index:
            self._archive.append(frame)
        if frame.is_held_out:
            self._held_out.add(index)
        elif frame.depth is not None:
            self._take_in_depth(frame, index, trajectory)
        if len(self._archive) < MIN_CHUNKS:
            return
        first_time = len(self._archive) == MIN_CHUNKS
        steps = self._config.initial_iterations if first_time else self._config.iterations
        for _ in range(steps):
            # A young map's errors would pull the poses along: they are adjusted to the finished one.
            self._optimise(trajectory, 0.4, self._reduction(), adjusts_poses=False)
        self._prune()

    def finish(self, trajectory: Trajectory, progress: Progress) -> None:
        """Refine map and poses over everything kept, with falling learning rates."""
        steps = self._config.final_iterations
        if len(self._archive) < MIN_CHUNKS:
            return
        self._solve_brightness(trajectory)
        for k in range(steps):
            rate = 0.05 ** (k / steps)  # ends at a twentieth
            self.gaussians.decay_rates(rate)
            self._refiner.rate = self._config.poses_rate * rate
            adjusts_poses = self._adjusts_poses and k >= ADJUST_FROM * steps
            self._optimise(trajectory, 0.0, self._reduction(), adjusts_poses)
            if not progress((k + 1) / steps):
                break
        self._prune()

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> View:
        """Return the map seen from a pose."""
        return render_view(self.gaussians, camera, T_world_camera, self._config.background)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gaussians' centres and brightness."""
        with torch.no_grad():
            gaussians = self.gaussians.activated()
        return gaussians.means.detach().numpy(), gaussians.colors.numpy()[:, 0]

    # --- growing ---

    def _take_in_depth(self, frame: Frame, index: int, trajectory: Trajectory) -> None:
        assert frame.depth is not None
        T = trajectory.pose(index)
        candidate = Keyframe(index, frame.timestamp, frame.depth, frame.level(1).depth)
        with torch.no_grad():
            view = self._render(self.gaussians.activated(), torch.from_numpy(T))
        if not self.keyframes or self._is_keyframe(candidate, view.visible, trajectory):
            self.keyframes.append(candidate)
        self._recent = [*self._recent, candidate][-self._keyframe_config.num_chunks :]
        self._archive.forget_details(keep=self._chunks_in_window())
        self._add_gaussians(candidate, T, view)

    def _is_keyframe(self, frame: Keyframe, visible: Tensor, trajectory: Trajectory) -> bool:
        last = self.keyframes[-1]
        T_last, T_now = trajectory.pose(last.index), trajectory.pose(frame.index)
        with torch.no_grad():
            seen = self._render(self.gaussians.activated(), torch.from_numpy(T_last)).visible
        union = int((visible | seen).sum())
        covisibility = int((visible & seen).sum()) / max(union, 1)
        translation = float(np.linalg.norm(T_now[:3, 3] - T_last[:3, 3]))
        measured = frame.depth[frame.depth > 0]
        median_depth = float(np.median(measured)) if len(measured) else np.inf
        return is_keyframe(covisibility, translation, median_depth, self._keyframe_config)

    def _chunks_in_window(self) -> set[int]:
        """Chunks whose inner times are kept: the N nearest each keyframe, and the last N."""
        n = self._keyframe_config.num_chunks
        chunks = set(range(len(self._archive) - n, len(self._archive)))
        for keyframe in self.keyframes:
            start = keyframe.index - n // 2
            chunks |= set(range(start, start + n))
        return chunks

    def _add_gaussians(self, frame: Keyframe, T_world_camera: np.ndarray, view: RenderOutput) -> None:
        """Add Gaussians at the pixels that Eq. 13 selects, one per stride x stride block."""
        config = self._config
        alpha, intensity = view.alpha.numpy(), view.intensity.numpy()
        mask = densify_mask(
            alpha, view.expected_depth.numpy(), frame.depth, config.min_visibility, config.depth_error_factor
        )
        s = config.pixel_stride
        grid = np.zeros_like(mask)
        grid[s // 2 :: s, s // 2 :: s] = True
        points, pixels = depth_to_points(frame.depth, self._camera, T_world_camera, mask & grid)
        room = config.max_gaussians - len(self.gaussians)
        points, pixels = points[:room], pixels[:room]
        if len(points) == 0:
            return
        x, y = pixels[:, 0], pixels[:, 1]
        size = 0.6 * s * frame.depth[y, x] / self._camera.fx  # just overlapping at the block's spacing
        brightness = _neighbouring_brightness(intensity, alpha, config.background)[y, x]
        self.gaussians.add(
            torch.from_numpy(points.astype(np.float32)),
            torch.from_numpy(size.astype(np.float32))[:, None].repeat(1, 3),
            config.initial_opacity,
            torch.from_numpy(brightness.astype(np.float32))[:, None],
        )

    def _prune(self) -> None:
        """Remove Gaussians that have faded."""
        keep = self.gaussians.raw["logit_opacities"].detach().sigmoid() > self._config.min_opacity
        if not bool(keep.all()):
            self.gaussians.keep(keep)

    # --- optimising ---

    def _solve_brightness(self, trajectory: Trajectory) -> None:
        """Set every Gaussian's brightness from all events at once; see brightness.py."""
        eligible = [c for c in range(len(self._archive)) if c not in self._held_out]
        chosen = [eligible[int(k)] for k in np.linspace(0, len(eligible) - 1, min(len(eligible), MAX_SOLVED))]
        with torch.no_grad():
            gaussians = self.gaussians.activated()
            seen = [
                self._render(gaussians, torch.from_numpy(trajectory.pose(c))).dominant.numpy().ravel()
                for c in chosen
            ]
        sums = [self._archive.sum_before(c, 0).ravel() for c in chosen]
        epsilon = self._config.log_epsilon
        prior = np.log(gaussians.colors.detach().numpy()[:, 0].astype(np.float64) + epsilon)
        level = solve_log_brightness(
            np.array(seen), np.array(sums, np.float32) * self._contrast_threshold, prior
        )
        observed = np.zeros(len(prior), bool)
        visible = np.unique(np.array(seen))
        observed[visible[visible >= 0]] = True
        if 0 < observed.sum() < len(prior):  # those never in front follow their neighbours
            means = gaussians.means.detach().numpy()
            neighbours = list(range(1, 1 + min(3, int(observed.sum()))))
            _, nearest = cKDTree(means[observed]).query(means[~observed], k=neighbours)
            level[~observed] = level[observed][nearest].mean(-1)
        # Events do not know the absolute level: put the brightest percent of what is seen near white.
        in_view = level[np.array(seen)[np.array(seen) >= 0]]
        if len(in_view):
            level += np.log(WHITE + epsilon) - np.percentile(in_view, 99)
        brightness = np.exp(level) - epsilon
        self.gaussians.set_colors(torch.from_numpy(brightness.astype(np.float32))[:, None])

    def _reduction(self) -> int:
        """Draw the size of the next step's images: reduced ones cost two thirds of full ones."""
        return REDUCTION if self._random.random() < self._config.reduced_share else 1

    def _optimise(
        self, trajectory: Trajectory, newest_share: float, reduction: int, adjusts_poses: bool
    ) -> None:
        """One step of Eq. 16 on a random event interval, and now and then a depth image."""
        config = self._config
        poses = _Poses(trajectory, adjusts_poses)
        gaussians = self.gaussians.activated()
        start, end = self._draw_interval(newest_share)
        polarity = self._archive.sum_before(*end) - self._archive.sum_before(*start)
        measured = self._contrast_threshold * block_means(polarity.astype(np.float32), reduction)  # Eq. 11
        views = [self._render(gaussians, self._pose_at(poses, edge), reduction) for edge in (start, end)]
        predicted = brightness_change(views[0].intensity, views[1].intensity, config.log_epsilon)
        event = event_loss(predicted, torch.from_numpy(measured))
        loss = config.event_weight * event
        if self._num_steps % config.depth_every == 0 and config.depth_weight > 0:
            frame = self._draw_depth(newest_share)
            view = self._render(gaussians, poses.of_frame(frame.index), reduction)
            depth = torch.from_numpy(frame.depth if reduction == 1 else frame.reduced_depth)
            loss = loss + config.depth_weight * depth_loss(view.depth, depth)
        if config.scale_weight > 0:
            loss = loss + config.scale_weight * scale_loss(
                self.gaussians.raw["log_scales"], config.max_scale_ratio
            )
        loss.backward()
        self.gaussians.step()
        for index, delta in poses.deltas.items():
            if delta.grad is not None:
                self._refiner.step(index, delta.grad.numpy(), trajectory)
        self._num_steps += 1
        value = float(event.detach())
        self.loss = value if np.isnan(self.loss) else 0.95 * self.loss + 0.05 * value

    def _render(self, gaussians: Gaussians, T_world_camera: Tensor, reduction: int = 1) -> RenderOutput:
        return render(gaussians, self._camera, T_world_camera, self._config.background, reduction)

    def _pose_at(self, poses: _Poses, edge: tuple[int, int]) -> Tensor:
        chunk, bin_index = edge
        return poses.within(chunk, bin_index / self._config.bins_per_chunk)

    def _draw_interval(self, newest_share: float) -> tuple[tuple[int, int], tuple[int, int]]:
        """Draw the two edges (chunk, bin) of an interval, its length from `intervals`."""
        edges = self._edges()
        times = np.array([self._archive.edges[c][b] for c, b in edges])
        length = float(self._random.choice(self._config.intervals))
        length = min(length, times[-1] - times[0])
        newest = self._random.random() < newest_share
        end_time = times[-1] if newest else self._random.uniform(times[0] + length, times[-1])
        end = int(np.abs(times - end_time).argmin())
        start = int(np.abs(times - (times[end] - length)).argmin())
        if start == end:
            start, end = (end - 1, end) if end > 0 else (0, 1)
        return edges[min(start, end)], edges[max(start, end)]

    def _edges(self) -> list[tuple[int, int]]:
        """Return all times at which an interval may begin or end, held-out times left out."""
        result = []
        for chunk in range(len(self._archive)):
            for b, _ in enumerate(self._archive.times(chunk)):
                fraction = b / self._config.bins_per_chunk
                near_start = chunk in self._held_out and fraction < HELD_OUT_MARGIN
                near_end = chunk + 1 in self._held_out and fraction > 1 - HELD_OUT_MARGIN
                if not (near_start or near_end):
                    result.append((chunk, b))
        return result

    def _draw_depth(self, newest_share: float) -> Keyframe:
        if self._random.random() < newest_share:
            return self._recent[-1]
        frames = self.keyframes + self._recent
        return frames[int(self._random.integers(len(frames)))]


def block_means(image: np.ndarray, reduction: int) -> np.ndarray:  # [H, W] -> [H / r, W / r]
    """Return the means of blocks of reduction x reduction pixels, odd edges cut off."""
    if reduction == 1:
        return image
    h, w = image.shape[0] // reduction, image.shape[1] // reduction
    cut = image[: h * reduction, : w * reduction]
    return cut.reshape(h, reduction, w, reduction).mean((1, 3), dtype=np.float32)


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


def _neighbouring_brightness(
    intensity: np.ndarray,  # [H, W] rendered
    alpha: np.ndarray,  # [H, W]
    default: float,
) -> np.ndarray:  # [H, W]
    """Return the mean brightness of what is already mapped within 7 pixels, else the default."""
    mapped = (alpha > 0.8).astype(np.float32)
    weight = cv2.blur(mapped, (15, 15))
    mean = cv2.blur(intensity * mapped, (15, 15)) / np.maximum(weight, 1e-6)
    return np.where(weight > 0.01, mean, default)
