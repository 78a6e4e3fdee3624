"""Compares edges of depth with events: is depth that of the event camera, and does it lie where events are?

Where a nearer surface ends there is nearly always an edge of brightness, too, so events lie on the edges of
depth. The correlation of the two images, as a function of a displacement of one, then has its peak near zero.
It is elsewhere if depth is of a camera beside the event camera.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from edslam_ti.datasets import EventDepthSequence
from edslam_ti.inspection.event_volume import EventVolume

MOST_IMAGES = 30
MARGIN = 0.03  # s between a depth image and the ends of the events
SHARE = 0.25  # events per pixel in the event image
LARGEST = 12  # px of the reduced image, displacements that are tried
PEAK = 3  # px around a place that belong to its peak
JUMP, STEEPER, LARGEST_JUMP = 0.05, 2.0, 0.3  # relative, of an edge; times its neighbours' slope; counted
FEWEST = 20  # pixels on edges
HOLE = 3.0  # px of missing depth that are bridged


@dataclass(frozen=True)
class EdgeCheck:
    """Where depth edges and events fit."""

    here: float  # height of the correlation at no displacement, in standard deviations of its surroundings
    best: float  # the same at the best displacement
    displacement: tuple[float, float]  # x, y in pixels of the full image, of the events against depth
    num_images: int


def check_edges(sequence: EventDepthSequence, volume: EventVolume) -> EdgeCheck | None:
    """Return how depth edges fit events; None: too few edges."""
    stamps = sequence.depth_timestamps
    inside = np.flatnonzero((stamps > volume.start + MARGIN) & (stamps < volume.end - MARGIN))
    inside = inside[:: max(1, -(-len(inside) // MOST_IMAGES))]
    side = 2 * LARGEST + 1
    total = np.zeros((side, side))
    number = 0
    for k in inside:
        depth = sequence.depth_or_none(int(k))
        if depth is None:
            continue
        edges = depth_edges(reduced(depth, volume.factor, volume.camera.shape)) ** 2
        if np.count_nonzero(edges) < FEWEST:
            continue
        events = contrasted(np.minimum(volume.around(float(stamps[k]), SHARE), 5))
        total += _correlation(contrasted(edges), events)
        number += 1
    if number == 0:
        return None
    y, x = np.unravel_index(int(total.argmax()), total.shape)
    place = ((int(x) - LARGEST) * volume.factor, (int(y) - LARGEST) * volume.factor)
    return EdgeCheck(_height(total, LARGEST, LARGEST), _height(total, int(x), int(y)), place, number)


def depth_edges(depth: np.ndarray) -> np.ndarray:  # [H, W] m -> [H, W] float32
    """Return how far depth jumps between each pixel and its neighbours, as a share; 0 on smooth surfaces."""
    depth = _with_narrow_holes_filled(depth)
    with np.errstate(divide="ignore"):
        inverse = np.where(depth > 0, 1 / depth, np.nan)
    edges = np.zeros(depth.shape, np.float32)
    for axis in (0, 1):
        values, out = np.moveaxis(inverse, axis, 0), np.moveaxis(edges, axis, 0)
        step = np.abs(np.diff(values, axis=0))
        slope = np.zeros_like(step)
        slope[1:-1] = np.fmax(step[:-2], step[2:])
        with np.errstate(invalid="ignore"):
            jump = step / np.minimum(values[1:], values[:-1])
            is_edge = (jump > JUMP) & (step > STEEPER * slope)
        height = np.where(is_edge, np.minimum(jump, LARGEST_JUMP), 0).astype(np.float32) / 2
        out[1:] += height
        out[:-1] += height
    return edges


def _with_narrow_holes_filled(depth: np.ndarray) -> np.ndarray:  # [H, W] m
    """Return depth with the value of the nearest measured pixel up to `HOLE` pixels away where it is missing.

    Structured light and stereo measure nothing beside an edge, which then lies in the middle of a hole.
    """
    missing = (depth <= 0).astype(np.uint8)
    if not missing.any() or missing.all():
        return depth
    distance, labels = cv2.distanceTransformWithLabels(
        missing, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    values = np.zeros(int(labels.max()) + 1, depth.dtype)
    values[labels[missing == 0]] = depth[missing == 0]
    return np.where((missing == 1) & (distance <= HOLE), values[labels], depth)


def reduced(depth: np.ndarray, factor: int, shape: tuple[int, int]) -> np.ndarray:  # [H, W] -> [h, w] m
    """Return the nearest depth of every block of factor x factor pixels, 0 where there is none."""
    if factor == 1:
        return depth
    height, width = shape
    blocks = depth[: height * factor, : width * factor].reshape(height, factor, width, factor)
    nearest = np.where(blocks > 0, blocks, np.inf).min((1, 3))
    return np.asarray(np.where(np.isfinite(nearest), nearest, 0))


def contrasted(image: np.ndarray) -> np.ndarray:  # [H, W] float32
    """Return the square root of an image without its slow changes, smoothed a little."""
    root = np.sqrt(image)
    return np.asarray(cv2.GaussianBlur(root, (0, 0), 0.7) - cv2.GaussianBlur(root, (0, 0), 4.0))


def _correlation(first: np.ndarray, second: np.ndarray) -> np.ndarray:  # [H, W] each -> [2 LARGEST + 1, ...]
    """Return the correlation for displacements of the second image of up to `LARGEST` pixels."""
    a, b = first - first.mean(), second - second.mean()
    padded = 2 * a.shape[0], 2 * a.shape[1]
    product = np.conj(np.fft.rfft2(a, padded)) * np.fft.rfft2(b, padded)
    values = np.roll(np.fft.irfft2(product, padded), (LARGEST, LARGEST), (0, 1))
    norm = np.sqrt((a * a).sum() * (b * b).sum()) + 1e-12
    return np.asarray(values[: 2 * LARGEST + 1, : 2 * LARGEST + 1] / norm)


def _height(values: np.ndarray, x: int, y: int) -> float:
    """Return how far the peak near a place stands out, in standard deviations of the rest."""
    top, left = max(y - 1, 0), max(x - 1, 0)
    peak = float(values[top : y + 2, left : x + 2].max())
    rest = values.copy()
    rest[max(y - PEAK, 0) : y + PEAK + 1, max(x - PEAK, 0) : x + PEAK + 1] = np.nan
    return (peak - float(np.nanmean(rest))) / (float(np.nanstd(rest)) + 1e-12)
