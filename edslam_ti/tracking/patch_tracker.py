"""Bidirectional patch alignment of time surfaces and depth (Sec. III-B, Eq. 2-5)."""

from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from edslam_ti.alignment import MIN_PIXELS, is_observed, levenberg_marquardt, residual_model
from edslam_ti.camera import Camera
from edslam_ti.config import TimeSurfaceConfig, TrackingConfig
from edslam_ti.frame import Frame
from edslam_ti.geometry import adjoint, inverse, orthonormalized
from edslam_ti.kernels.patch_warp import (
    Alignment,
    Direction,
    NormalEquations,
    compile_kernels,
    extract_patches,
)
from edslam_ti.tracking.surfaces import SurfaceFrame, SurfaceFrameBuilder
from edslam_ti.tracking.tracker import Attempt, TrackingResult, best_attempt
from edslam_ti.tracking.uncertainty import measured
from edslam_ti.trajectory import Trajectory


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
            T_reference_camera = inverse(T_world_reference) @ T_world_camera
            poses.append(inverse(T_reference_camera))
            unknowns.append(-np.eye(6))
            if self.is_bidirectional:
                poses.append(T_reference_camera)
                unknowns.append(adjoint(T_reference_camera))
        systems = self.alignment.linearise(poses)
        if self.alignment.is_compositional:  # their unknown: exp(xi) T = T exp(Ad(T^-1) xi)
            systems = [s.transformed(np.linalg.inv(adjoint(T))) for s, T in zip(systems, poses)]
        first, *rest = (system.transformed(unknown) for system, unknown in zip(systems, unknowns))
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

    def consistency(self, trajectory: Trajectory) -> None:
        """Return None: time surfaces alone are too inaccurate to judge the data."""

    def refer_to(self, frame: Frame) -> None:
        """Align the next frames to this one, whose pose is on the trajectory, and drop earlier references."""
        self._surfaces.reset()
        self._keyframe = self._previous = self._with_patches(frame)

    def _track(self, current: _Reference, predicted: np.ndarray, trajectory: Trajectory) -> Attempt:
        def attempt(start: np.ndarray) -> Attempt:
            reference = trajectory.index_of(self._references()[0].view.frame.timestamp)
            return self._judge(self._align(current, start, trajectory), predicted, reference)

        return best_attempt(attempt, predicted, trajectory.pose(-1))

    def _judge(self, alignment: _Alignment, predicted: np.ndarray, reference: int) -> Attempt:
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
        measurement = measured(reference, [system])
        result = TrackingResult(alignment.T_world_camera, True, quality, measurement=measurement)
        return Attempt(result, True, overlap)

    def _align(self, current: _Reference, guess: np.ndarray, trajectory: Trajectory) -> _Alignment:
        T = guess
        references = [(r, trajectory.at(r.view.frame.timestamp)) for r in self._references()]
        for level in reversed(range(self._config.levels)):
            problem = self._problem(current, references, level)
            T, system = levenberg_marquardt(problem.linearise, T, self._config.iterations)
        return _Alignment(orthonormalized(T) if np.isfinite(T).all() else guess, system)

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
        """Return Eq. 5 over all references, in both directions unless settings or missing depth exclude one.

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

        Before the first events there is no surface: then patches are drawn wherever there is depth.
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


def _distinct(centres: np.ndarray) -> np.ndarray:  # [P, 2] of non-negative int64
    """Return the different rows, in order: `np.unique(centres, axis=0)` without its sort of records."""
    return np.stack(np.divmod(np.unique(centres[:, 0] << 32 | centres[:, 1]), 1 << 32), -1)
