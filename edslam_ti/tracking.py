"""Bidirectional patch alignment of time surfaces and depth (Sec. III-B, Eq. 2-5)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from torch import Tensor

from edslam_ti.camera import Camera
from edslam_ti.config import TimeSurfaceConfig, TrackingConfig
from edslam_ti.frame import Frame
from edslam_ti.geometry import exp_matrix, orthonormalized, rigid_inverse
from edslam_ti.surface_frame import SurfaceFrame, SurfaceFrameBuilder
from edslam_ti.trajectory import Trajectory
from kernels.patch_warp import (
    Alignment,
    Direction,
    NormalEquations,
    ResidualModel,
    adjoint,
    compile_kernels,
    extract_patches,
)

MIN_PIXELS = 200  # fewer residuals than this constrain no pose
MAX_CONDITION = 1e7  # of the normal equations: beyond, some motion is not observed
SMALL_GAIN = 1e-4  # relative decrease of the cost: converged


@dataclass(frozen=True)
class TrackingResult:
    """A pose and how far it can be trusted. A failure is a result, not an exception."""

    T_world_camera: np.ndarray  # [4, 4]
    converged: bool
    quality: float  # fraction of patch pixels in agreement, 0 to 1
    message: str = ""  # why it failed, or what else is worth the log


@dataclass(frozen=True)
class Attempt:
    """A result, and whether it needs no second one from another start."""

    result: TrackingResult
    is_sure: bool
    overlap: float  # share of the reference in view
    misfit: float = 0.0  # median absolute difference of log brightness


class Tracker(Protocol):
    """Finds the pose of a frame; the first frame gets the pose it is expected at."""

    def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the pose of `frame`, expected near `guess` [4, 4]; `trajectory` holds those before it."""


class TruePoses:
    """A tracker that knows: `--poses truth`, for mapping alone."""

    def __init__(self, true_pose: Callable[[float], np.ndarray | None]) -> None:
        self._true_pose = true_pose

    def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the true pose."""
        pose = self._true_pose(frame.timestamp)
        if pose is None:
            return TrackingResult(guess, False, 0.0, "no true pose at this time")
        return TrackingResult(pose, True, 1.0)


@dataclass(frozen=True)
class _Reference:
    """A frame to align to, with its patches at every pyramid level."""

    view: SurfaceFrame
    points: list[Tensor]  # [blocks, 4 or 16, LANES] each, from `Patches.points`
    has_surface: bool  # False: too few events yet, only its depth can be aligned


@dataclass(frozen=True)
class _Alignment:
    T_world_camera: np.ndarray
    system: NormalEquations  # at the finest level


@dataclass(frozen=True)
class _Problem:
    """Normal equations of one frame at one pyramid level, as a function of its pose."""

    alignment: Alignment
    references: list[np.ndarray]  # [4, 4] T_world_camera of each
    is_bidirectional: bool

    def linearise(self, T_world_camera: np.ndarray) -> NormalEquations:  # [4, 4]
        """Return Eq. 5's normal equations over all references, for T_world_camera <- T exp(xi)."""
        # T_camera_reference <- exp(-xi) T_camera_reference, so that its unknown is -xi; and
        # T_reference_camera exp(xi) = exp(Ad(T_reference_camera) xi) T_reference_camera.
        poses, unknowns = [], []
        for T_world_reference in self.references:
            T_reference_camera = rigid_inverse(T_world_reference) @ T_world_camera
            poses.append(rigid_inverse(T_reference_camera))
            unknowns.append(-np.eye(6))
            if self.is_bidirectional:
                poses.append(T_reference_camera)
                unknowns.append(adjoint(T_reference_camera))
        first, *rest = (
            system.transformed(unknown) for system, unknown in zip(self.alignment.linearise(poses), unknowns)
        )
        return sum(rest, start=first)


class BidirectionalPatchTracker:
    """Aligns each frame to its references by Levenberg-Marquardt on SE(3), coarse to fine."""

    def __init__(
        self, camera: Camera, surface_config: TimeSurfaceConfig, config: TrackingConfig, seed: int
    ) -> None:
        self._config = config
        self._surfaces = SurfaceFrameBuilder(camera, surface_config)
        self._random = np.random.default_rng(seed)
        self._keyframe: _Reference | None = None
        self._previous: _Reference | None = None
        self._model = residual_model(config, config.surface_sigma)
        self._depth_only = replace(self._model, surface_sigma=1e4)  # in effect infinite
        compile_kernels()

    def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the pose of `frame` relative to the references' poses on the trajectory."""
        current = self._with_patches(frame)
        has_depth = frame.depth is not None and bool((frame.depth > 0).any())
        can_be_aligned = current.has_surface or (has_depth and self._model.depth_weight > 0)
        can_be_reference = can_be_aligned and frame.depth is not None
        if self._keyframe is None:
            if can_be_reference:
                self._keyframe = self._previous = current
            return TrackingResult(guess, True, 1.0)
        if not can_be_aligned:
            return TrackingResult(guess, False, 0.0, "too few events, and no depth to align instead")
        best = self._track(current, guess, trajectory)
        if can_be_reference:
            if best.overlap < self._config.min_overlap or not best.result.converged:
                self._keyframe = current
            self._previous = current
        return best.result

    def refer_to(self, frame: Frame) -> None:
        """Align the next frames to this one, whose pose is on the trajectory, and forget earlier ones."""
        self._surfaces.reset()
        self._keyframe = self._previous = self._with_patches(frame)

    def _track(self, current: _Reference, predicted: np.ndarray, trajectory: Trajectory) -> Attempt:
        def attempt(start: np.ndarray) -> Attempt:
            return self._judge(self._align(current, start, trajectory), predicted)

        return best_attempt(attempt, predicted, trajectory.pose(-1))

    def _judge(self, alignment: _Alignment, predicted: np.ndarray) -> Attempt:
        """Return the result and the overlap; a failed alignment falls back to the predicted pose."""
        system = alignment.system
        usable = max(system.num_usable, 1)
        overlap = system.num_surface / usable
        quality = max(0.0, 1.0 - system.cost / (system.num_surface * (1 + self._model.depth_weight) + 1) / 4)
        quality *= min(1.0, overlap)
        message = ""
        if system.num_surface < MIN_PIXELS:
            message = f"only {system.num_surface} patch pixels visible"
        elif overlap < self._config.min_inliers:
            message = f"only {overlap:.0%} of patch pixels agree in depth"
        elif not is_observed(system):
            message = "motion not fully observed (ill-conditioned)"
        if message:
            return Attempt(TrackingResult(predicted, False, quality, message), False, overlap)
        return Attempt(TrackingResult(alignment.T_world_camera, True, quality), True, overlap)

    def _align(self, current: _Reference, guess: np.ndarray, trajectory: Trajectory) -> _Alignment:
        T = guess
        references = [(r, trajectory.at(r.view.frame.timestamp)) for r in self._references()]
        for level in reversed(range(self._config.levels)):
            problem = self._problem(current, references, level)
            T, system = levenberg_marquardt(problem.linearise, T, self._config.iterations)
        return _Alignment(orthonormalized(T), system)

    def _references(self) -> list[_Reference]:
        assert self._keyframe is not None
        assert self._previous is not None
        if self._config.references == "previous":
            return [self._previous]
        if self._config.references == "keyframe" or self._keyframe is self._previous:
            return [self._keyframe]
        return [self._keyframe, self._previous]

    def _problem(
        self, current: _Reference, references: list[tuple[_Reference, np.ndarray]], level: int
    ) -> "_Problem":
        """Return Eq. 5 over all references, in both directions unless the settings or the depth rule one out.

        The new frame's patches can be warped only where it has depth.
        """
        is_bidirectional = self._config.directions == "both" and current.view.frame.depth is not None
        now = current.view.level(level)
        directions: list[Direction] = []
        for view, (reference, _) in enumerate(references, start=1):
            model = self._model if reference.has_surface and current.has_surface else self._depth_only
            directions.append(Direction(reference.points[level], 0, model))
            if is_bidirectional:
                directions.append(Direction(current.points[level], view, model))
        views = [now, *(reference.view.level(level) for reference, _ in references)]
        alignment = Alignment(
            directions, np.stack([view.surface_and_depth for view in views]), now.camera.intrinsics
        )
        return _Problem(alignment, [T for _, T in references], is_bidirectional)

    def _with_patches(self, frame: Frame) -> _Reference:
        """Draw patches where the time surface exceeds its threshold and depth is known.

        Before the first events there is no surface: then they are drawn where there is depth.
        """
        config, view = self._config, self._surfaces.build(frame)
        finest = view.level(0)
        has_depth = finest.depth > 0
        on_surface = has_depth & (finest.surface > config.min_time_surface)
        has_surface = int((finest.surface > config.min_time_surface).sum()) >= MIN_PIXELS
        rows, columns = np.nonzero(on_surface if has_surface else has_depth)
        chosen = self._random.permutation(len(rows))[: config.num_patches]
        centres = np.stack([columns[chosen], rows[chosen]], -1)
        points = []
        for k in range(config.levels):
            level = view.level(k)
            size = config.patch_size if k == 0 else max(3, config.patch_size // 2 | 1)
            at_level = _distinct(centres >> k) if k else centres
            patches = extract_patches(level.surface, level.depth, at_level.astype(np.int32), size)
            template = (level.surface, level.depth) if config.form == "compositional" else None
            points.append(patches.points(level.camera.intrinsics, template))
        return _Reference(view, points, has_surface)


def residual_model(config: TrackingConfig, surface_sigma: float) -> ResidualModel:
    """Return how residuals are weighted, given the standard deviation of those of what is aligned."""
    return ResidualModel(
        max_depth_difference=config.max_depth_difference,
        surface_sigma=surface_sigma,
        depth_weight=config.depth_weight,
        depth_sigma=config.depth_sigma,
        depth_sigma_2=config.depth_sigma_2,
        huber_threshold=config.huber_threshold,
    )


def is_observed(system: NormalEquations) -> bool:
    """Return whether all six motions show in what is aligned (well-conditioned normal equations)."""
    eigenvalues = np.linalg.eigvalsh(system.H)
    return bool(eigenvalues[0] > eigenvalues[-1] / MAX_CONDITION)


def best_attempt(
    attempt: Callable[[np.ndarray], Attempt],  # from a start [4, 4]
    predicted: np.ndarray,  # [4, 4] at constant velocity
    last: np.ndarray,  # [4, 4] as after a sudden stop
) -> Attempt:
    """Return the attempt of better quality; the one from the last pose is left out if the first is sure."""
    first = attempt(predicted)
    if first.is_sure:
        return first
    second = attempt(last)
    return second if second.result.quality > first.result.quality else first


def levenberg_marquardt(
    linearise: Callable[[np.ndarray], NormalEquations],
    T_world_camera: np.ndarray,  # [4, 4] start
    iterations: int,
    small_gain: float = SMALL_GAIN,
) -> tuple[np.ndarray, NormalEquations]:
    """Minimise over T <- T exp(xi), given the normal equations at a pose; return pose and system.

    It ends when the cost decreases by less than `small_gain` of itself.
    """
    T, damping = T_world_camera, 1e-4
    system = linearise(T)
    for _ in range(iterations):
        if system.num_surface < MIN_PIXELS or system.cost == 0:
            break
        H = system.H + np.diag(damping * system.H.diagonal() + 1e-9)
        candidate_T = T @ exp_matrix(-np.linalg.solve(H, system.g))
        candidate = linearise(candidate_T)
        gain = 1 - _mean_cost(candidate) / _mean_cost(system)
        if gain > 0:
            T, system, damping = candidate_T, candidate, max(damping / 5, 1e-7)
            if gain < small_gain:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    return T, system


def _distinct(centres: np.ndarray) -> np.ndarray:  # [P, 2] of non-negative int64
    """Return the different rows, in order: `np.unique(centres, axis=0)` without its sort of records."""
    return np.stack(np.divmod(np.unique(centres[:, 0] << 32 | centres[:, 1]), 1 << 32), -1)


def _mean_cost(system: NormalEquations) -> float:
    """Return the cost per visible pixel, with a charge for pixels lost from view."""
    if system.num_surface == 0:
        return np.inf
    lost = max(system.num_usable - system.num_surface, 0)
    return (system.cost + 1.0 * lost) / max(system.num_usable, 1)
