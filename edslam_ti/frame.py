"""A sample as tracking and mapping see it, and how its images are reduced."""

from dataclasses import dataclass

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import Sample
from edslam_ti.events import Events


@dataclass(frozen=True)
class Frame:
    """The end of an event chunk: everything tracking and mapping see of it."""

    timestamp: float  # seconds
    previous_timestamp: float  # seconds, start of its event chunk
    events: Events  # of its chunk
    camera: Camera
    depth: np.ndarray | None  # [H, W] float32 metres, 0 = missing
    image: np.ndarray | None  # [H, W] float32 in [0, 1]; only RGB-D baselines look at it
    is_held_out: bool = False  # kept from mapping, for evaluation


def downscaled(image: np.ndarray) -> np.ndarray:  # [H, W] -> [H / 2, W / 2]
    """Return the means of 2x2 blocks; odd edges are cut off."""
    a, b, c, d = _corners(image)
    mean: np.ndarray = image.dtype.type(0.25) * (a + b + c + d)
    return mean


def downscaled_depth(depth: np.ndarray) -> np.ndarray:  # [H, W] -> [H / 2, W / 2]
    """Return means of 2x2 blocks where all four depths exist and lie on one surface, else 0 (missing)."""
    a, b, c, d = _corners(depth)
    low = np.minimum(np.minimum(a, b), np.minimum(c, d))
    high = np.maximum(np.maximum(a, b), np.maximum(c, d))
    is_smooth = (low > 0) & (high - low < 0.05 * high)
    return np.where(is_smooth, 0.25 * (a + b + c + d), np.float32(0))


def _corners(image: np.ndarray) -> list[np.ndarray]:  # four [H / 2, W / 2]
    """Return the four pixels under every pixel of the image at half size."""
    h, w = (n // 2 for n in image.shape)
    return [image[y : 2 * h : 2, x : 2 * w : 2] for y in (0, 1) for x in (0, 1)]


class FrameBuilder:
    """Turns samples into frames; they must come in order of time."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._previous: float | None = None

    def build(self, sample: Sample, is_held_out: bool = False) -> Frame:
        """Return the frame at the end of the sample."""
        start = sample.timestamp if self._previous is None else self._previous
        self._previous = sample.timestamp
        return Frame(
            timestamp=sample.timestamp,
            previous_timestamp=start,
            events=sample.events,
            camera=self._camera,
            depth=sample.depth,
            image=sample.image,
            is_held_out=is_held_out,
        )
