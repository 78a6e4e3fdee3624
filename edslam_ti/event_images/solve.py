"""Log-brightness images solved from events, depth and poses, without a camera.

Let l be the unknown log brightness at one time and E_k the change from there to time k (Eq. 11). The image at
time k is l + E_k. A surface point seen at pixel x of frame j and at x' = w(x) of frame k (Eq. 3, through
measured depth) has the same brightness in both:

    l(x) + E_j(x) = l(x') + E_k(x')          for every pixel with depth and many pairs of frames

with l and E_k at x' interpolated bilinearly. The equations are linear in l, and leave absolute brightness
unknown. A time surface (Eq. 1) lags behind its edges by an amount that depends on the motion. This image does
not depend on the motion, so alignment to it is unbiased. There are two uses:

- The tracker solves for the image at a keyframe's time, where E_j = 0, from pairs of the keyframe with a few
  other frames (`solve_log_brightness_image`), often and at reduced size.
- The mapper solves for the image at the start of some seconds of events, from pairs of many frames
  (`solve_start_image`). The unknowns are the pixels of one image, however long the recording, so least
  squares takes seconds. Gradient descent on single intervals (Eq. 12) needs thousands of steps for the low
  frequencies. Frames whose image is already known, from an earlier start image, enter as constants.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.depth_images import block_depth, block_means
from edslam_ti.geometry import inverse
from edslam_ti.kernels import brightness_image, time_surface
from edslam_ti.kernels.brightness_image import ChangeImage, Pair, solve_brightness_image
from edslam_ti.kernels.runtime import check_shape

# Huber thresholds in log brightness; equations with larger residuals count less (occlusions, reflections,
# wrong depth). Frames of a start image are farther apart, so errors of their events have accumulated longer.
HUBER, START_HUBER = 0.1, 0.15
ROBUST = (False, True)  # two solves of a start image: the second uses weights from the first one's residuals
PRIOR_WEIGHT = 1e-3  # weight of the previous start image, relative to one equation
OFFSETS = (1, 2, 5, 9)  # difference of the indices of a pair of views


# --- the image of a keyframe ---


@dataclass(frozen=True)
class Observation:
    """One time at which a keyframe's surfaces were seen."""

    T_camera_keyframe: np.ndarray  # [4, 4]
    change: np.ndarray  # [h, w] log brightness: E_k since the keyframe (for earlier times, minus the change)
    depth: np.ndarray | None  # [h, w] metres, 0 = missing; for occlusion


def solve_log_brightness_image(
    depth: np.ndarray,  # [h, w] of the keyframe, metres, 0 = missing
    camera: Camera,  # of these images
    observations: Sequence[Observation],
    prior: np.ndarray,  # [h, w] previous log brightness; kept where nothing was observed
    prior_weight: float = 1e-3,  # relative to one equation
    iterations: int = 12,
    is_robust: bool = True,
) -> np.ndarray:  # [h, w] float32
    """Return the keyframe's log brightness by conjugate gradients.

    `is_robust`: equations that the prior fits badly count less (Huber).
    """
    check_shape("prior", prior, depth.shape)
    own = ChangeImage(np.zeros(depth.shape, np.float32), depth)
    images = [own, *(ChangeImage(o.change, o.depth) for o in observations)]
    pairs = [Pair(0, k, o.T_camera_keyframe) for k, o in enumerate(observations, 1)]
    image, _ = solve_brightness_image(
        images, pairs, camera.intrinsics, prior, prior_weight, HUBER, iterations, [is_robust]
    )
    return image


# --- the start image ---


@dataclass(frozen=True)
class EventView:
    """Measurements of the event camera up to the time of a frame."""

    change: np.ndarray  # [H, W] float32 log brightness, minus the start image if `is_relative` (Eq. 11)
    depth: np.ndarray | None  # [H, W] float32 metres, 0 = missing
    T_world_camera: np.ndarray  # [4, 4]
    is_relative: bool = True


@dataclass(frozen=True)
class StartImage:
    """Log brightness at the start of a window."""

    log_brightness: np.ndarray  # [H, W] float32
    is_observed: np.ndarray  # [H, W] bool: compared with other pixels; elsewhere interpolated


def solve_start_image(
    views: Sequence[EventView],  # in order of time
    camera: Camera,
    start: np.ndarray,  # [H, W] float32, initial value
    iterations: dict[int, int],  # of conjugate gradients for each reduction of the images, coarse first
) -> StartImage:
    """Return the start image, by iteratively reweighted least squares from coarse to fine.

    Only its difference to `start` is solved at reduced size, so smaller details of `start` survive.
    """
    log_brightness, observed = start.astype(np.float32), np.zeros(camera.shape, bool)
    T_camera_world = [inverse(v.T_world_camera) for v in views]
    pairs = [Pair(k, j, T_camera_world[j] @ views[k].T_world_camera) for k, j in _pairs(views)]
    for reduction, count in iterations.items():
        small = camera if reduction == 1 else camera.downscaled(reduction)
        images = [_reduced(view, reduction) for view in views]
        before = block_means(log_brightness, reduction)
        solution, seen = solve_brightness_image(
            images, pairs, small.intrinsics, before, PRIOR_WEIGHT, START_HUBER, count, ROBUST, is_strict=True
        )
        difference = _filled(solution - before, seen)
        log_brightness = log_brightness + _enlarged(difference, camera.shape)
        observed |= _enlarged(seen.astype(np.float32), camera.shape) > 0.5
    return StartImage(log_brightness, observed)


def _reduced(view: EventView, reduction: int) -> ChangeImage:
    depth = None if view.depth is None else block_depth(view.depth, reduction)
    return ChangeImage(block_means(view.change, reduction), depth, not view.is_relative)


def _pairs(views: Sequence[EventView]) -> list[tuple[int, int]]:
    """Return pairs of views at short and long distances in the list, in both directions."""
    offsets = OFFSETS if len(views) < 12 else OFFSETS[1:]
    pairs = [(k, k + o) for o in offsets for k in range(len(views) - o)]
    pairs += [(j, k) for k, j in pairs]
    return [(k, j) for k, j in pairs if views[k].is_relative or views[j].is_relative]


def _filled(values: np.ndarray, known: np.ndarray) -> np.ndarray:  # [h, w]
    """Return the values where known, else the mean of what is known nearby (or 0)."""
    result, weight = np.where(known, values, 0).astype(np.float32), known.astype(np.float32)
    filled, total = result.copy(), weight.copy()
    for size in (5, 15, 45):
        blurred = cv2.blur(result, (size, size)), cv2.blur(weight, (size, size))
        gap = (total == 0) & (blurred[1] > 1e-3)
        filled[gap], total[gap] = blurred[0][gap] / blurred[1][gap], 1
    return filled


def _enlarged(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:  # [h, w] -> [H, W]
    """Return an image of block means enlarged bilinearly to full size; odd edges repeat the last block."""
    if image.shape == shape:
        return image
    r = shape[1] // image.shape[1]
    h, w = image.shape[0] * r, image.shape[1] * r
    enlarged = cv2.resize(image.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
    return np.pad(enlarged, ((0, shape[0] - h), (0, shape[1] - w)), mode="edge")


def compile_kernels() -> None:
    """Compile the kernels that images need, so that the first frames of a sequence do not wait for it."""
    brightness_image.compile_kernels()
    time_surface.compile_kernels()
