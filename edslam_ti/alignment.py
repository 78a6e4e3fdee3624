"""Levenberg-Marquardt on SE(3), for every alignment of images and depth (Eq. 5)."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from torch import Tensor

from edslam_ti.camera import Camera
from edslam_ti.config import TrackingConfig
from edslam_ti.geometry import inverse, se3_exp
from edslam_ti.kernels.patch_warp import Alignment, Direction, NormalEquations, ResidualModel

MIN_PIXELS = 200  # fewer residuals than this constrain no pose
MAX_CONDITION = 1e7  # condition number of the normal equations beyond which some motion is not observed
SMALL_GAIN = 1e-4  # converged at this relative decrease of the cost


def residual_model(config: TrackingConfig, surface_sigma: float) -> ResidualModel:
    """Return how residuals are weighted; `surface_sigma` is the standard deviation of image residuals."""
    return ResidualModel(
        max_depth_difference=config.max_depth_difference,
        surface_sigma=surface_sigma,
        depth_weight=config.depth_weight,
        depth_sigma=config.depth_sigma,
        depth_sigma_2=config.depth_sigma_2,
        huber_threshold=config.huber_threshold,
    )


def is_observed(system: NormalEquations) -> bool:
    """Return whether all six motions are observed (the normal equations are well-conditioned)."""
    if not np.isfinite(system.H).all():
        return False
    eigenvalues = np.linalg.eigvalsh(system.H)
    return bool(eigenvalues[0] > eigenvalues[-1] / MAX_CONDITION)


def linearised(
    points: Tensor,  # of the reference
    model: ResidualModel,
    view: list[np.ndarray],  # [h, w] log brightness and depth (metres, 0 = missing)
    camera: Camera,  # of the view
) -> Callable[[np.ndarray], NormalEquations]:
    """Return the normal equations of a view's alignment as a function of T_reference_camera."""
    alignment = Alignment([Direction(points, 0, model)], cv2.merge(view)[None], camera.intrinsics)

    def linearise(T_reference_camera: np.ndarray) -> NormalEquations:
        # T exp(xi) moves T_camera_reference to exp(-xi) T_camera_reference
        (system,) = alignment.linearise([inverse(T_reference_camera)])
        return system.transformed(-np.eye(6))

    return linearise


def gauss_newton_step(system: NormalEquations) -> np.ndarray | None:  # [6]
    """Return the twist that minimises a linearised system; None: it has no unique minimum."""
    try:
        step = -np.linalg.solve(system.H, system.g)
    except np.linalg.LinAlgError:
        return None
    return step if np.isfinite(step).all() else None


def levenberg_marquardt(
    linearise: Callable[[np.ndarray], NormalEquations],
    T_world_camera: np.ndarray,  # [4, 4] start
    iterations: int,
    small_gain: float = SMALL_GAIN,
) -> tuple[np.ndarray, NormalEquations]:
    """Minimise over T <- T exp(xi), given the normal equations at a pose; return pose and system.

    Iteration ends when the relative decrease of the cost is below `small_gain`.
    """
    T, damping = T_world_camera, 1e-4
    system = linearise(T)
    for _ in range(iterations):
        if system.num_surface < MIN_PIXELS or system.cost == 0:
            break
        H = system.H + np.diag(damping * system.H.diagonal() + 1e-9)
        step = gauss_newton_step(replace(system, H=H))
        if step is None:  # nothing to align: the caller sees that no motion is observed
            break
        candidate_T = T @ se3_exp(step)
        candidate = linearise(candidate_T)
        gain = 1 - mean_cost(candidate) / mean_cost(system)
        if gain > 0:
            T, system, damping = candidate_T, candidate, max(damping / 5, 1e-7)
            if gain < small_gain:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    return T, system


def mean_cost(system: NormalEquations) -> float:
    """Return the cost per usable pixel, with a penalty for pixels lost from view."""
    if system.num_surface == 0:
        return np.inf
    lost = max(system.num_usable - system.num_surface, 0)
    return (system.cost + 1.0 * lost) / max(system.num_usable, 1)
