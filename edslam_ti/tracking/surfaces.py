"""Frames with a time surface (Eq. 1) and an image pyramid, for alignment of patches."""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.config import TimeSurfaceConfig
from edslam_ti.depth_images import downscaled, downscaled_depth
from edslam_ti.event_images.noisy import NoisyPixels
from edslam_ti.events import Events
from edslam_ti.frame import Frame
from edslam_ti.kernels.time_surface import time_surface, update_last_timestamps


@dataclass(frozen=True)
class PyramidLevel:
    """One scale of a frame; level 0 is the full image."""

    camera: Camera
    surface: np.ndarray  # [h, w] float32 in [0, 1]
    depth: np.ndarray  # [h, w] float32 metres, 0 = missing

    @cached_property
    def surface_and_depth(self) -> np.ndarray:  # [h, w, 2] float32
        return cv2.merge([self.surface, self.depth])


class SurfaceFrame:
    """A frame's time surface and depth at every scale."""

    def __init__(self, frame: Frame, surface: np.ndarray) -> None:
        """`surface` [H, W] float32 in [0, 1]."""
        self.frame = frame
        depth = frame.tracked_depth
        depth = depth if depth is not None else np.zeros(frame.camera.shape, np.float32)
        self._pyramid = [PyramidLevel(frame.camera, surface, depth)]

    def level(self, k: int) -> PyramidLevel:
        """Return the frame at 1 / 2^k of its size; without depth, depth is all missing."""
        while len(self._pyramid) <= k:
            last = self._pyramid[-1]
            camera = last.camera.downscaled(2)
            self._pyramid.append(PyramidLevel(camera, downscaled(last.surface), downscaled_depth(last.depth)))
        return self._pyramid[k]


class SurfaceFrameBuilder:
    """Builds the surfaces of consecutive frames; keeps the last time stamp of every pixel."""

    def __init__(self, camera: Camera, config: TimeSurfaceConfig) -> None:
        self._config = config
        self._last_timestamps = np.full(camera.shape, -np.inf)
        self.noisy_pixels = NoisyPixels(camera.shape)

    def build(self, frame: Frame) -> SurfaceFrame:
        """Add the frame's events, and return the frame with its smoothed surface."""
        events = frame.events
        update_last_timestamps(events.x, events.y, events.t, self._last_timestamps)
        self.noisy_pixels.add(frame.event_counts)
        surface = time_surface(self._last_timestamps, frame.timestamp, self._config.decay)
        surface = self.noisy_pixels.replaced(surface)
        if self._config.blur > 0:
            surface = cv2.GaussianBlur(surface, (0, 0), self._config.blur)
        return SurfaceFrame(replace(frame, events=Events.empty()), surface)  # they are in the surface

    def reset(self) -> None:
        """Remove all events."""
        self._last_timestamps.fill(-np.inf)
