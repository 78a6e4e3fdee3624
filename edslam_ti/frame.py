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
            surface = _blocks(last.surface, camera.shape).mean(-1)
            self._pyramid.append(PyramidLevel(camera, surface, _downscaled_depth(last.depth, camera.shape)))
        return self._pyramid[k]


def _blocks(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:  # [h, w, 4]
    """Return the 2x2 block of every pixel of the image at half size."""
    h, w = shape
    return image[: 2 * h, : 2 * w].reshape(h, 2, w, 2).swapaxes(1, 2).reshape(h, w, 4)


def _downscaled_depth(depth: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return block means where all four depths exist and lie on one surface, else missing."""
    blocks = _blocks(depth, shape)
    low, high = blocks.min(-1), blocks.max(-1)
    return np.where((low > 0) & (high - low < 0.05 * high), blocks.mean(-1), 0).astype(np.float32)


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
