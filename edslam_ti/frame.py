"""A sample made ready for tracking and mapping: its time surface (Eq. 1) and its image pyramid."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.config import TimeSurfaceConfig
from edslam_ti.datasets.base import Sample
from edslam_ti.events import Events
from kernels.time_surface import time_surface, update_last_timestamps


@dataclass(frozen=True)
class PyramidLevel:
    """One scale of a frame; level 0 is the full image."""

    camera: Camera
    surface: np.ndarray  # [h, w] float32 in [0, 1]
    depth: np.ndarray  # [h, w] float32 metres, 0 = missing

    @cached_property
    def surface_and_depth(self) -> np.ndarray:  # [h, w, 2] float32
        return cv2.merge([self.surface, self.depth])


@dataclass(frozen=True)
class Frame:
    """The end of an event chunk: everything tracking and mapping see of it."""

    timestamp: float  # seconds
    previous_timestamp: float  # seconds, start of its event chunk
    events: Events  # of its chunk
    camera: Camera
    surface: np.ndarray  # [H, W] float32, smoothed time surface
    depth: np.ndarray | None  # [H, W] float32 metres, 0 = missing
    image: np.ndarray | None  # [H, W] float32 in [0, 1]; only RGB-D baselines look at it
    is_held_out: bool = False  # kept from mapping, for evaluation

    def level(self, k: int) -> PyramidLevel:
        """Return the frame at 1 / 2^k of its size; without depth, depth is all missing."""
        return self._pyramid[k] if k < len(self._pyramid) else self._extend(k)

    @cached_property
    def _pyramid(self) -> list[PyramidLevel]:
        depth = self.depth if self.depth is not None else np.zeros(self.camera.shape, np.float32)
        return [PyramidLevel(self.camera, self.surface, depth)]

    def _extend(self, k: int) -> PyramidLevel:
        while len(self._pyramid) <= k:
            last = self._pyramid[-1]
            camera = last.camera.downscaled(2)
            self._pyramid.append(PyramidLevel(camera, downscaled(last.surface), downscaled_depth(last.depth)))
        return self._pyramid[k]


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
    """Keeps the last time stamp of every pixel and turns samples into frames."""

    def __init__(self, camera: Camera, config: TimeSurfaceConfig) -> None:
        self._camera = camera
        self._config = config
        self._last_timestamps = np.full(camera.shape, -np.inf)
        self._previous: float | None = None

    def build(self, sample: Sample, is_held_out: bool = False) -> Frame:
        """Return the frame at the end of the sample; samples must come in order of time."""
        events = sample.events
        update_last_timestamps(events.x, events.y, events.t, self._last_timestamps)
        surface = time_surface(self._last_timestamps, sample.timestamp, self._config.decay)
        if self._config.blur > 0:
            surface = cv2.GaussianBlur(surface, (0, 0), self._config.blur)
        start = sample.timestamp if self._previous is None else self._previous
        self._previous = sample.timestamp
        return Frame(
            timestamp=sample.timestamp,
            previous_timestamp=start,
            events=events,
            camera=self._camera,
            surface=surface,
            depth=sample.depth,
            image=sample.image,
            is_held_out=is_held_out,
        )
