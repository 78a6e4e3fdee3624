"""Keyframes with a log-brightness image, and direct alignment of images and depth to them.

All poses here are relative to the keyframe; the tracker knows where keyframes are in the world
(image_tracker.py).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from edslam_ti.alignment import (
    MIN_PIXELS,
    gauss_newton_step,
    is_observed,
    levenberg_marquardt,
    linearised,
    residual_model,
)
from edslam_ti.camera import NEAREST, Camera
from edslam_ti.config import TrackingConfig
from edslam_ti.depth_images import downscaled, downscaled_depth
from edslam_ti.event_images.solve import Observation, compile_kernels, solve_log_brightness_image
from edslam_ti.frame import Frame
from edslam_ti.geometry import inverse, orthonormalized, se3_exp
from edslam_ti.kernels import depth_average
from edslam_ti.kernels.depth_average import DepthAgreement, PixelRays, average_depth
from edslam_ti.kernels.patch_warp import NormalEquations, Patches

# Not a setting: below this relative decrease of the cost, the next, finer level takes over.
SMALL_GAIN = 1e-3


@dataclass(frozen=True)
class Depth:
    """A depth image, as measured and at the size of brightness images; metres, 0 = missing."""

    full: np.ndarray  # [H, W]
    small: np.ndarray  # [h, w]


@dataclass(frozen=True)
class BrightnessFrame:
    """Measurements up to one frame, at the size of brightness images."""

    index: int  # of the frame in the trajectory
    timestamp: float  # seconds
    change: np.ndarray  # [h, w] log brightness since the segment of events began
    depth: Depth | None


@dataclass
class BrightnessKeyframe:
    """A frame with depth, and the log-brightness image solved for it."""

    index: int  # of the frame in the trajectory
    change: np.ndarray  # [h, w] as in `BrightnessFrame`
    measured: Depth  # at its time
    depth: Depth  # averaged with depth of neighbouring frames
    log_brightness: np.ndarray  # [h, w]
    points: list[Tensor]  # pixels to align, at full and at half size; see `Patches.points`
    depth_points: Tensor | None  # pixels of the full depth image to align
    next_solution: int  # index of the frame at which the image is solved for again
    is_new_place: bool = True  # no older keyframe shows the same place

    def image_at(self, frame: BrightnessFrame) -> np.ndarray:  # [h, w]
        """Return the log brightness at another frame of the same segment of events."""
        return self.log_brightness + (frame.change - self.change)

    def reduced(self) -> "BrightnessKeyframe":
        """Return the keyframe without the parts that relocalisation does not need: 1/20 of the memory."""
        small = Depth(self.depth.small, self.depth.small)
        nothing = np.zeros((0, 0), np.float32)
        return replace(self, change=nothing, measured=small, depth=small, points=[], depth_points=None)


@dataclass(frozen=True)
class Aligned:
    """A pose aligned to a keyframe, and how well it fits."""

    T_keyframe_camera: np.ndarray  # [4, 4]
    system: NormalEquations  # at full size
    misfit: float  # median absolute difference of log brightness
    last: tuple[NormalEquations, ...]  # systems of the last step, one for each kind of residual

    @property
    def overlap(self) -> float:
        """Share of the keyframe's pixels in view."""
        return self.system.num_surface / max(self.system.num_usable, 1)

    def quality(self, config: TrackingConfig) -> float:
        """Return how far the pose can be trusted, from 0 to 1."""
        return min(1.0, self.overlap) * max(0.0, 1 - self.misfit / config.images.max_misfit)

    def problem(self, config: TrackingConfig) -> str:
        """Return why the pose cannot be trusted; empty if it can."""
        if self.system.num_surface < MIN_PIXELS:
            return f"only {self.system.num_surface} pixels of the keyframe in view"
        if self.overlap < config.min_inliers:
            return f"only {self.overlap:.0%} of the keyframe in view"
        if not is_observed(self.system):
            return "motion not fully observed (ill-conditioned)"
        if self.misfit > config.images.max_misfit:
            return f"brightness differs by {self.misfit:.2f} (median, log)"
        return ""


class KeyframeAligner:
    """Solves for keyframes' images, and aligns images and depth of other frames to them."""

    def __init__(self, camera: Camera, config: TrackingConfig, seed: int) -> None:
        # Images are halved until they are about `image_width` wide, which averages out noise of events.
        self._level = max(0, round(math.log2(camera.width / config.images.image_width)))
        self._camera = camera
        self._rays = PixelRays(camera.shape, camera.intrinsics)
        self._cameras = [camera.downscaled(2 ** (self._level + k)) for k in range(2)]
        self._random = np.random.default_rng(seed + 1)
        self._settings = config.images
        self._model = residual_model(config, config.brightness_sigma)
        self._brightness_only = replace(self._model, depth_weight=0.0)
        self._depth_only = replace(self._model, surface_sigma=1e4)  # in effect infinite
        compile_kernels()
        depth_average.compile_kernels()

    @property
    def camera(self) -> Camera:
        """The camera of brightness images."""
        return self._cameras[0]

    @property
    def random_state(self) -> Mapping[str, Any]:
        """The state of the generator that chooses pixels: whoever tries something in vain puts it back."""
        return self._random.bit_generator.state

    @random_state.setter
    def random_state(self, state: Mapping[str, Any]) -> None:
        self._random.bit_generator.state = state

    # --- a keyframe's image ---

    def brightness_frame(
        self,
        index: int,  # of the frame in the trajectory
        frame: Frame,
        change: np.ndarray,  # [H, W] log brightness
    ) -> BrightnessFrame:
        """Return the measurements up to a frame, at the size of brightness images."""
        for _ in range(self._level):
            change = downscaled(change)
        depth = None if frame.tracked_depth is None else self._reduced(frame.tracked_depth)
        return BrightnessFrame(index, frame.timestamp, change, depth)

    def _reduced(self, depth: np.ndarray) -> Depth:  # [H, W] metres
        small = depth
        for _ in range(self._level):
            small = downscaled_depth(small)
        return Depth(depth, small)

    def solve(
        self,
        keyframe: BrightnessKeyframe,
        frames: Sequence[BrightnessFrame],
        poses: Sequence[np.ndarray],  # [4, 4] T_camera_keyframe at these frames
        iterations: int,
        is_robust: bool,
    ) -> None:
        """Solve for the keyframe's image, average its depth, and choose its pixels to align."""
        keyframe.depth = self._averaged_depth(keyframe, frames, poses)
        observations = [
            Observation(T, f.change - keyframe.change, None if f.depth is None else f.depth.small)
            for f, T in zip(frames, poses, strict=True)
        ]
        keyframe.log_brightness = solve_log_brightness_image(
            keyframe.depth.small, self.camera, observations, keyframe.log_brightness,
            iterations=iterations, is_robust=is_robust,
        )  # fmt: skip
        keyframe.points = self._points(keyframe)
        keyframe.depth_points = self._rays.points(keyframe.depth.full)

    def _averaged_depth(
        self, keyframe: BrightnessKeyframe, frames: Sequence[BrightnessFrame], poses: Sequence[np.ndarray]
    ) -> Depth:
        """Return the keyframe's depth averaged with that of other frames where they agree."""
        with_depth = [(f.depth.full, T) for f, T in zip(frames, poses) if f.depth is not None]
        average = average_depth(
            keyframe.measured.full,
            [depth for depth, _ in with_depth],
            [T for _, T in with_depth],
            self._rays,
            DepthAgreement(self._model.depth_sigma, self._model.depth_sigma_2),
        )
        return self._reduced(average)

    def with_points(self, keyframe: BrightnessKeyframe) -> BrightnessKeyframe:
        """Return a reduced keyframe with pixels to align."""
        return replace(keyframe, points=self._points(keyframe))

    def _points(self, keyframe: BrightnessKeyframe) -> list[Tensor]:
        """Return pixels to align, at full and at half size."""
        image, depth = keyframe.log_brightness, keyframe.depth.small
        return [self._chosen(image, depth, 0), self._chosen(downscaled(image), downscaled_depth(depth), 1)]

    def _chosen(self, image: np.ndarray, depth: np.ndarray, level: int) -> Tensor:  # [blocks, 4, LANES]
        """Return random pixels with depth, those with a strong gradient first."""
        down, right = np.gradient(image)
        v, u = np.nonzero(depth)
        order = self._random.permutation(len(v))
        is_strong = np.hypot(down, right)[v, u][order] > self._settings.strong_gradient
        order = np.concatenate([order[is_strong], order[~is_strong]])[: self._settings.num_pixels >> level]
        v, u = v[order], u[order]
        pixels = np.stack([u, v, 1 / depth[v, u]], -1).astype(np.float32)
        return Patches(pixels, image[v, u]).points(self._cameras[level].intrinsics)

    # --- alignment ---

    def align(
        self,
        keyframe: BrightnessKeyframe,
        image: np.ndarray,  # [h, w] log brightness
        depth: Depth | None,
        start: np.ndarray,  # [4, 4] T_keyframe_camera
    ) -> Aligned:
        """Align an image, and its depth where there is any, to a keyframe, coarse to fine."""
        small = np.zeros_like(image) if depth is None else depth.small
        steps = self._settings.steps if depth is not None else 2 * self._settings.steps
        T = start
        for level, view in ((1, [downscaled(image), downscaled_depth(small)]), (0, [image, small])):
            linearise = linearised(keyframe.points[level], self._model, view, self._cameras[level])
            T, system = levenberg_marquardt(linearise, T, steps, SMALL_GAIN)
        last: tuple[NormalEquations, ...] = (system,)
        if depth is not None and keyframe.depth_points is not None and self._model.depth_weight > 0:
            # Reduced depth is blurred at edges: the last step uses depth at full size.
            nothing = np.zeros_like(depth.full)
            brightness = linearised(keyframe.points[0], self._brightness_only, [image, small], self.camera)
            geometry = linearised(
                keyframe.depth_points, self._depth_only, [nothing, depth.full], self._camera
            )
            last = brightness(T), geometry(T)
            both = last[0] + last[1]
            step = gauss_newton_step(both)  # the minimum is near
            if step is None:
                system = both  # the caller sees that some motion is not observed
            else:
                T = T @ se3_exp(step)
        T = orthonormalized(T) if np.isfinite(T).all() else start
        difference = self.difference(keyframe, image, T)
        misfit = float(np.median(np.abs(difference))) if len(difference) else np.inf
        return Aligned(T, system, misfit, last)

    def align_depth(
        self, keyframe: BrightnessKeyframe, depth: Depth, start: np.ndarray
    ) -> tuple[np.ndarray, NormalEquations]:
        """Align depth alone to a keyframe's; return T_keyframe_camera and the last system."""
        T = start
        for level, image in ((1, downscaled_depth(depth.small)), (0, depth.small)):
            view = [np.zeros_like(image), image]
            linearise = linearised(keyframe.points[level], self._depth_only, view, self._cameras[level])
            T, system = levenberg_marquardt(linearise, T, self._settings.steps)
        return orthonormalized(T), system

    # --- what is in view ---

    def difference(
        self, keyframe: BrightnessKeyframe, image: np.ndarray, T_keyframe_camera: np.ndarray
    ) -> np.ndarray:
        """Return an image minus the keyframe's, at the keyframe's pixels in view (nearest neighbours)."""
        x, y, u, v = self._warped(keyframe.depth.small, inverse(T_keyframe_camera))
        column, row = np.rint(x).astype(int), np.rint(y).astype(int)
        height, width = image.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return image[row[inside], column[inside]] - keyframe.log_brightness[v[inside], u[inside]]

    def flow(self, depth: np.ndarray, T_b_a: np.ndarray) -> float:  # [h, w] of a
        """Return the median optical flow from view a to view b, pixels."""
        x, y, u, v = self._warped(depth, T_b_a)
        return float(np.median(np.hypot(x - u, y - v))) if len(x) else 0.0

    def share_in_view(self, keyframe: BrightnessKeyframe, T_keyframe_camera: np.ndarray) -> float:
        """Return the share of a keyframe's pixels with depth that are in view, hidden ones included."""
        x, y, _, _ = self._warped(keyframe.depth.small, inverse(T_keyframe_camera))
        inside = (x >= 0) & (x < self.camera.width) & (y >= 0) & (y < self.camera.height)
        return float(inside.sum() / max(np.count_nonzero(keyframe.depth.small[::2, ::2]), 1))

    def _warped(self, depth: np.ndarray, T_b_a: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return where every fourth pixel of a depth image is seen from b: x, y, and u, v in a."""
        v, u = 2 * np.stack(np.nonzero(depth[::2, ::2]))
        points = self.camera.back_project_pixels(u, v, depth[v, u])
        points = (T_b_a[:3, :3] @ points.T + T_b_a[:3, 3:]).T
        front = points[:, 2] > NEAREST
        x, y, _ = self.camera.project(points[front], NEAREST)
        return x, y, u[front], v[front]
