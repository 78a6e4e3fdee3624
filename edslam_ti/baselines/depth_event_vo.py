"""Depth-event visual odometry (Zuo et al. 2022), re-implemented from the paper; no code of the authors'.

A keyframe's semi-dense points are the pixels with depth where its time surface (Eq. 1) is high: edges. The
negated time surface of a later moment is a potential field, low where an edge is now. The pose makes the
points fall to the bottom of the field:

    minimise over T  sum_i rho(1 - S(x_i)),   x_i = pi(T p_i),   S the time surface, rho Huber's function

by Lucas and Kanade's forward compositional method, T <- T exp(xi) with T = T_camera_keyframe. Several time
surfaces are made for each frame and aligned in turn, so that each alignment starts within the field's reach.
What differs from the authors' version is in docs/methods/depth_event_vo.md.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from edslam_ti.camera import NEAREST, Camera
from edslam_ti.config import DepthEventVoConfig, TimeSurfaceConfig
from edslam_ti.frame import Frame
from edslam_ti.geometry import interpolate, inverse, orthonormalized, se3_exp, skew
from edslam_ti.tracking.surfaces import SurfaceFrame, SurfaceFrameBuilder
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.trajectory import Trajectory

MIN_POINTS = 100  # fewer in view constrain no pose
MAX_CONDITION = 1e7  # of the normal equations; beyond it some motion is not observed
SMALL_GAIN = 1e-3  # converged at this relative decrease of the cost
SUPPORT = 0.5  # a point with a lower potential lies on an edge of the field


@dataclass(frozen=True)
class PotentialField:
    """The negated time surface and its slope."""

    planes: Tensor  # [3, H, W] potential in [0, 1], its derivatives along x and y per pixel
    intrinsics: tuple[float, float, float, float]

    @staticmethod
    def of(surface: Tensor, camera: Camera) -> "PotentialField":  # [H, W] in [0, 1]
        """Return the field of a time surface; slopes are central differences."""
        potential = 1 - surface
        down, across = torch.gradient(potential)
        return PotentialField(torch.stack([potential, across, down]), camera.intrinsics)

    def sampled(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # [N] pixels
        """Return potential, slopes along x and y, and whether the pixels are inside; 1, 0, 0 outside."""
        _, height, width = self.planes.shape
        is_inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        grid = torch.stack([2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1], -1)[None, None]
        values = torch.nn.functional.grid_sample(self.planes[None], grid, align_corners=True)[0, :, 0]
        potential = torch.where(is_inside, values[0], torch.ones_like(x))
        across, down = (torch.where(is_inside, v, torch.zeros_like(x)) for v in values[1:])
        return potential, across, down, is_inside


@dataclass(frozen=True)
class Linearised:
    """The cost of a pose and its normal equations in xi of T exp(xi)."""

    H: Tensor  # [6, 6] float64
    g: Tensor  # [6] float64
    cost: float  # mean of rho over all points
    num_inside: int  # points in view
    support: float  # share of all points that lie on an edge


def linearised(
    field: PotentialField,
    points: Tensor,  # [N, 3] metres, keyframe
    T_camera_keyframe: Tensor,  # [4, 4] float64
    huber_threshold: float,  # of potential
) -> Linearised:
    """Return the cost and its Gauss-Newton system; points out of view have the highest potential."""
    fx, fy, cx, cy = field.intrinsics
    T = T_camera_keyframe.to(points.dtype)
    moved = points @ T[:3, :3].T + T[:3, 3]
    x, y, z = moved.unbind(-1)
    near = z.clamp_min(NEAREST)
    potential, across, down, is_inside = field.sampled(fx * x / near + cx, fy * y / near + cy)
    is_inside = is_inside & (z > NEAREST)
    potential = torch.where(is_inside, potential, torch.ones_like(potential))
    # d potential / d moved, then d moved / d xi = R [1, -skew(p)]
    a, b = across * fx / near, down * fy / near
    slope = torch.where(is_inside, 1.0, 0.0)[:, None] * torch.stack([a, b, -(a * x + b * y) / near], -1)
    in_keyframe = slope @ T[:3, :3]
    J = torch.cat([in_keyframe, -(in_keyframe[:, None] @ skew(points))[:, 0]], -1)
    weight = (huber_threshold / potential.clamp_min(1e-6)).clamp_max(1.0)
    cut = potential.clamp_max(huber_threshold)
    weighted = J * weight[:, None]
    return Linearised(
        (weighted.T @ J).double(),
        (weighted.T @ potential).double(),
        float((cut * (potential - 0.5 * cut)).mean()),
        int(is_inside.sum()),
        float((potential < SUPPORT).float().mean()),
    )


def aligned(
    field: PotentialField,
    points: Tensor,  # [N, 3] metres, keyframe
    T_camera_keyframe: Tensor,  # [4, 4] float64, start
    config: DepthEventVoConfig,
) -> tuple[Tensor, Linearised]:
    """Return the pose that lowers the points' potential most, and the system there (Levenberg-Marquardt)."""
    T, damping = T_camera_keyframe, 1e-3
    system = linearised(field, points, T, config.huber_threshold)
    for _ in range(config.iterations):
        H = system.H + torch.diag(damping * system.H.diagonal() + 1e-9)
        candidate_T = T @ se3_exp(-torch.linalg.solve(H, system.g))
        candidate = linearised(field, points, candidate_T, config.huber_threshold)
        gain = 1 - candidate.cost / max(system.cost, 1e-12)
        if gain > 0:
            T, system, damping = candidate_T, candidate, max(damping / 5, 1e-6)
            if gain < SMALL_GAIN:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    return T, system


@dataclass(frozen=True)
class _Keyframe:
    points: Tensor  # [N, 3] metres, its own frame
    T_world_camera: np.ndarray  # [4, 4]
    median_depth: float  # metres


class DepthEventTracker:
    """Aligns semi-dense points of a keyframe to the potential field of each time surface (Tracker)."""

    def __init__(
        self,
        camera: Camera,
        surface_config: TimeSurfaceConfig,
        config: DepthEventVoConfig,
        seed: int,
        device: str = "cpu",
    ) -> None:
        self._camera = camera
        self._config = config
        self._device = device
        self._surfaces = SurfaceFrameBuilder(camera, surface_config)
        self._random = np.random.default_rng(seed)
        self._keyframe: _Keyframe | None = None

    def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the pose of `frame`; where the alignment fails, the guess, marked as lost."""
        keyframe = self._keyframe
        if keyframe is None:
            *_, surface = self._time_surfaces(frame)
            self._keyframe = self._as_keyframe(surface, guess)
            few = "" if self._keyframe is not None else "waiting for edges with depth"
            return TrackingResult(guess, True, 1.0, few)
        surface, T_world_camera, system = self._aligned(frame, keyframe, guess, trajectory)
        problem = self._problem(system)
        pose = guess if problem else orthonormalized(T_world_camera)
        if problem or self._is_far(keyframe, pose, system):
            self._keyframe = self._as_keyframe(surface, pose) or keyframe
        return TrackingResult(pose, not problem, system.support, problem)

    def consistency(self, trajectory: Trajectory) -> None:
        """Return None: it does not compare its data."""

    def _aligned(
        self, frame: Frame, keyframe: _Keyframe, guess: np.ndarray, trajectory: Trajectory
    ) -> tuple[SurfaceFrame, np.ndarray, Linearised]:
        """Return the last time surface, T_world_camera aligned to it, and the system there."""
        number, last = self._config.surfaces_per_frame, trajectory.pose(-1)
        step = inverse(last) @ interpolate(last, guess, 1 / number)  # at constant velocity
        T = last
        for surface in self._time_surfaces(frame):
            predicted = inverse(T @ step) @ keyframe.T_world_camera
            field = PotentialField.of(
                torch.from_numpy(surface.level(0).surface).to(self._device), self._camera
            )
            start = torch.from_numpy(predicted).to(self._device)
            T_camera_keyframe, system = aligned(field, keyframe.points, start, self._config)
            T = keyframe.T_world_camera @ inverse(T_camera_keyframe.cpu().numpy())
        return surface, T, system

    def _time_surfaces(self, frame: Frame) -> Iterator[SurfaceFrame]:
        """Yield the time surfaces at evenly spaced times up to the frame's; the last one has its depth."""
        number = self._config.surfaces_per_frame if self._keyframe is not None else 1
        times = np.linspace(frame.previous_timestamp, frame.timestamp, number + 1)
        for k in range(number):
            start, end = times[k] if k else -np.inf, times[k + 1] if k + 1 < number else np.inf
            part = replace(
                frame,
                events=frame.events.between(start, end),
                timestamp=float(times[k + 1]),
                depth=frame.depth if k + 1 == number else None,
            )
            yield self._surfaces.build(part)

    def _as_keyframe(self, surface: SurfaceFrame, T_world_camera: np.ndarray) -> _Keyframe | None:
        """Return a keyframe of edges with depth; None where there are too few."""
        level = surface.level(0)
        rows, columns = semi_dense_pixels(
            level.surface, level.depth, self._config.min_time_surface, self._config.num_points, self._random
        )
        if len(rows) < MIN_POINTS:
            return None
        depth = level.depth[rows, columns]
        points = self._camera.back_project_pixels(columns, rows, depth).astype(np.float32)
        return _Keyframe(torch.from_numpy(points).to(self._device), T_world_camera, float(np.median(depth)))

    def _problem(self, system: Linearised) -> str:
        """Return why the pose cannot be trusted; empty if it can."""
        if system.num_inside < MIN_POINTS:
            return f"only {system.num_inside} points of the keyframe in view"
        if system.support < self._config.min_support:
            return f"only {system.support:.0%} of the points lie on edges"
        eigenvalues = torch.linalg.eigvalsh(system.H)
        if not bool(eigenvalues[0] > eigenvalues[-1] / MAX_CONDITION):
            return "motion not fully observed (ill-conditioned)"
        return ""

    def _is_far(self, keyframe: _Keyframe, T_world_camera: np.ndarray, system: Linearised) -> bool:
        distance = np.linalg.norm(T_world_camera[:3, 3] - keyframe.T_world_camera[:3, 3])
        in_view = system.num_inside / len(keyframe.points)
        is_distant = bool(distance > self._config.keyframe_distance * keyframe.median_depth)
        return is_distant or in_view < self._config.min_overlap


def semi_dense_pixels(
    surface: np.ndarray,  # [H, W] in [0, 1]
    depth: np.ndarray,  # [H, W] metres, 0 = missing
    min_time_surface: float,
    most: int,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:  # [N] rows, [N] columns
    """Return at most `most` random pixels with depth where the time surface exceeds a value."""
    rows, columns = np.nonzero((surface > min_time_surface) & (depth > NEAREST))
    chosen = random.permutation(len(rows))[:most]
    return rows[chosen], columns[chosen]
