"""The image at the beginning, solved from events, depth and poses: afterwards events are images.

Events tell how the log brightness of a pixel has changed since the beginning, E_k(x) in Eq. 11, but not
what it was then. With the start image s known, every frame is an image without blur: s + E_k. A point seen
at pixel x of frame k and at x' = w(x) of frame j (Eq. 3, through measured depth) has one brightness:

    s(x) + E_k(x) = s(x') + E_j(x')        for every pixel with depth and many pairs of frames

with s and E_j at x' interpolated bilinearly. The unknowns are the pixels of one image however long the
recording, so least squares finds all of them in seconds, whatever their distance in the image, where descent
on single intervals (Eq. 12) needs thousands of steps for the low frequencies. Frames of another, earlier
stretch, whose start is known already, tie their s + E_k in as a given. Absolute brightness stays unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.depth_images import block_depth, block_means
from edslam_ti.kernels.brightness_image import ChangeImage, Pair, solve_brightness_image

HUBER = 0.15  # log brightness; beyond, an equation counts less (edges, reflections, wrong depth)
ROBUST = (False, True)  # solutions: the second counts equations less that the first fits badly
PRIOR_WEIGHT = 1e-3  # of the start's previous value against one equation
OFFSETS = (1, 2, 5, 9)  # in the list of views, between the two of a pair


@dataclass(frozen=True)
class EventView:
    """What the event camera has measured up to the time of a frame."""

    change: np.ndarray  # [H, W] float32 log brightness less the start image, Eq. 11; absolute if not relative
    depth: np.ndarray | None  # [H, W] float32 metres, 0 = missing
    T_world_camera: np.ndarray  # [4, 4]
    is_relative: bool = True


@dataclass(frozen=True)
class StartImage:
    """Log brightness at the beginning."""

    log_brightness: np.ndarray  # [H, W] float32
    is_observed: np.ndarray  # [H, W] bool: compared with other pixels; elsewhere as the neighbours


def solve_start_image(
    views: Sequence[EventView],  # in order of time
    camera: Camera,
    start: np.ndarray,  # [H, W] float32, where to begin; stays where nothing is observed
    iterations: dict[int, int],  # of conjugate gradients by reduction of the images, coarse first
) -> StartImage:
    """Return the start image, by iteratively reweighted least squares from coarse to fine.

    Only its difference to `start` is at reduced size: details of `start` smaller than that survive.
    """
    log_brightness, observed = start.astype(np.float32), np.zeros(camera.shape, bool)
    T_camera_world = [np.linalg.inv(v.T_world_camera) for v in views]
    pairs = [Pair(k, j, T_camera_world[j] @ views[k].T_world_camera) for k, j in _pairs(views)]
    for reduction, count in iterations.items():
        small = camera if reduction == 1 else camera.downscaled(reduction)
        images = [_reduced(view, reduction) for view in views]
        before = block_means(log_brightness, reduction)
        solution, seen = solve_brightness_image(
            images, pairs, small.intrinsics, before, PRIOR_WEIGHT, HUBER, count, ROBUST, is_strict=True
        )
        difference = _filled(solution - before, seen)
        log_brightness = log_brightness + _enlarged(difference, camera.shape)
        observed |= _enlarged(seen.astype(np.float32), camera.shape) > 0.5
    return StartImage(log_brightness, observed)


def _reduced(view: EventView, reduction: int) -> ChangeImage:
    depth = None if view.depth is None else block_depth(view.depth, reduction)
    return ChangeImage(block_means(view.change, reduction), depth, not view.is_relative)


def _pairs(views: Sequence[EventView]) -> list[tuple[int, int]]:
    """Return pairs of views at short and long distances in the list, both ways."""
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
    """Return an image of block means at full size, bilinearly; odd edges repeat the last block."""
    if image.shape == shape:
        return image
    r = shape[1] // image.shape[1]
    h, w = image.shape[0] * r, image.shape[1] * r
    enlarged = cv2.resize(image.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
    return np.pad(enlarged, ((0, shape[0] - h), (0, shape[1] - w)), mode="edge")
