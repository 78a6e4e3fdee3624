"""Refinement of poses with the map (Sec. III-E).

Bundle adjustment has two parts: gradient steps on poses and map together (`PoseRefiner`), and one alignment
of frames without depth to the map (`MapAligner`). Between depth images the tracker relies on one keyframe's
brightness and a motion prior. The map combines all frames: its errors are as large but independent, so the
pose half way between both is better than either. At frames with depth the tracker is better than the map.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from edslam_ti.alignment import MIN_PIXELS, is_observed, levenberg_marquardt, linearised, residual_model
from edslam_ti.camera import Camera
from edslam_ti.config import MappingConfig, TrackingConfig
from edslam_ti.geometry import inverse, is_near, orthonormalized, se3_exp, se3_log
from edslam_ti.kernels.patch_warp import Patches
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.rendering import render_map
from edslam_ti.mapping.targets import EventImages
from edslam_ti.trajectory import Trajectory

OPAQUE = 0.9  # a rendered pixel with at least this alpha shows a surface
SPACING = 2  # every second pixel in either direction is aligned
STEPS = 3  # of Levenberg-Marquardt: the pose is nearly right
FARTHEST = (0.02, 2.0)  # metres, degrees: larger corrections are rejected
SHARE = 0.5  # of each correction is applied: errors of tracker and map are equally large and independent


class PoseMemory:
    """The poses that the map was built from, for comparison with corrected ones."""

    def __init__(self) -> None:
        self._poses = np.zeros((0, 4, 4))

    def remember(self, trajectory: Trajectory) -> None:
        """Keep a copy of all present poses."""
        self._poses = trajectory.poses

    def corrections(self, trajectory: Trajectory) -> dict[int, np.ndarray]:  # [4, 4] by frame
        """Return T_new T_old^-1 for the frames whose pose has changed since `remember`."""
        poses, old = trajectory.poses, self._poses
        differ = np.flatnonzero((poses[: len(old)] != old).any((1, 2)))
        return {int(k): poses[k] @ inverse(old[k]) for k in differ}


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


class StepPose:
    """A pose T exp(delta) with delta = 0, differentiable in delta, for one step of optimisation."""

    def __init__(self, trajectory: Trajectory, index: int, is_free: bool) -> None:
        """`is_free`: optimise the pose. The first frame's pose stays fixed: it defines the world frame."""
        self.index = index
        self.T_world_camera = torch.from_numpy(trajectory.pose(index))  # [4, 4]
        self._delta: Tensor | None = None
        if is_free and index != 0:
            self._delta = torch.zeros(6, dtype=torch.float64, requires_grad=True)
            self.T_world_camera = self.T_world_camera @ se3_exp(self._delta)

    @property
    def gradient(self) -> np.ndarray | None:  # [6]
        """The loss's gradient in the twist, after `backward`; None for a pose that is fixed."""
        return None if self._delta is None or self._delta.grad is None else self._delta.grad.numpy()


class MapAligner:
    """Corrects poses by aligning images to renders of the map."""

    def __init__(self, camera: Camera, tracking: TrackingConfig, mapping: MappingConfig) -> None:
        self._camera = camera
        self._config = mapping
        self._model = replace(residual_model(tracking, tracking.brightness_sigma), depth_weight=0.0)

    def align(self, trajectory: Trajectory, images: EventImages, gaussians: GaussianMap) -> None:
        """Correct the poses of frames without depth."""
        for k in images.frames:
            if images.depth(k) is None:
                T = trajectory.pose(k)
                view = render_map(gaussians, self._camera, T, self._config.background)
                seen = np.log(view.intensity.numpy() + self._config.log_epsilon)
                depth, alpha = view.expected_depth.numpy(), view.alpha.numpy()
                trajectory.replace(k, self.corrected(images.log_brightness(k), seen, depth, alpha, T))

    def corrected(
        self,
        image: np.ndarray,  # [H, W] log brightness
        view: np.ndarray,  # [H, W] log brightness of the map, seen from the present pose
        depth: np.ndarray,  # [H, W] metres, of that view
        alpha: np.ndarray,  # [H, W] of that view
        T_world_camera: np.ndarray,  # [4, 4]
    ) -> np.ndarray:  # [4, 4]
        """Return the pose half way to the one aligned to the map; unchanged if that alignment is doubtful."""
        v, u = SPACING * np.stack(np.nonzero((alpha > OPAQUE)[::SPACING, ::SPACING]))
        if len(v) < MIN_PIXELS:
            return T_world_camera
        image = image - np.median(image[v, u] - view[v, u])  # their levels may differ
        pixels = np.stack([u, v, 1 / depth[v, u]], -1).astype(np.float32)
        points = Patches(pixels, view[v, u]).points(self._camera.intrinsics)
        no_depth = np.zeros(image.shape, np.float32)
        linearise = linearised(points, self._model, [image.astype(np.float32), no_depth], self._camera)
        T_view_camera, system = levenberg_marquardt(linearise, np.eye(4), STEPS)
        is_good = is_observed(system) and is_near(T_view_camera, *FARTHEST)
        return T_world_camera @ se3_exp(SHARE * se3_log(T_view_camera)) if is_good else T_world_camera
