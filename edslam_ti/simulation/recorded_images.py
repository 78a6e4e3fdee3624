"""Writes a simulated recording's grey and depth images."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.errors import DataError
from edslam_ti.sensor_config import DepthSensor
from edslam_ti.simulation.depth_noise import measured_depth
from edslam_ti.simulation.moving import MovingRenderer
from edslam_ti.simulation.paths import CameraPath
from edslam_ti.simulation.renderer import Render
from edslam_ti.simulation.settings import SimulationConfig
from edslam_ti.simulation.truth import DEPTH_UNITS_PER_METRE

MILLISECOND = 1_000_000  # nanoseconds


@dataclass
class ImageWriter:
    """Writes images at given times; each is the mean brightness over its exposure."""

    folder: Path
    times: list[int]  # nanoseconds
    exposure: float  # seconds
    _sums: dict[int, np.ndarray] = field(default_factory=dict)  # image time -> integral over ns
    _spans: dict[int, int] = field(default_factory=dict)
    _next: int = 0

    def add(self, start: int, grey_start: np.ndarray, end: int, grey_end: np.ndarray) -> None:
        """Add the brightness of the interval [start, end], linear in time."""
        half = round(self.exposure * 0.5e9)
        while self._next < len(self.times) and self.times[self._next] - half <= end:
            t = self.times[self._next]
            if half == 0:
                self._write(t, grey_end if t == end else grey_start)
            else:
                self._sums[t], self._spans[t] = np.zeros(grey_start.shape), 0
            self._next += 1
        for t in list(self._sums):
            low, high = max(start, t - half), min(end, t + half)
            if high > low:
                middle = ((low + high) / 2 - start) / (end - start)
                self._sums[t] += (high - low) * ((1 - middle) * grey_start + middle * grey_end)
                self._spans[t] += high - low
            if end >= t + half:
                self._finish(t)

    def finish(self) -> None:
        """Write images whose exposure extends beyond the recording."""
        for t in list(self._sums):
            self._finish(t)

    def _finish(self, t: int) -> None:
        self._write(t, self._sums.pop(t) / self._spans.pop(t))

    def _write(self, t: int, grey: np.ndarray) -> None:
        _write_png(self.folder / _frame_name(t), np.rint(255 * np.clip(grey, 0, 1)).astype(np.uint8))


@dataclass
class DepthWriter:
    """Writes depth images at given times, as the depth sensor measures them."""

    folder: Path
    times: set[int]  # nanoseconds
    config: SimulationConfig
    path: CameraPath
    renderer: MovingRenderer

    def add(self, t: int, render: Render) -> None:
        """Write a depth image if its stamp is `t`; `render` is what the event camera sees then."""
        if t not in self.times:
            return
        sensor = self.config.depth_measured_by
        if sensor.is_displaced:
            seconds = min(max(t / 1e9 - sensor.time_offset, 0.0), self.path.duration)
            render = self.renderer.render(self.path.pose(seconds) @ _displacement(sensor), seconds)
        depth = render.depth
        if not sensor.is_exact:
            rng = np.random.default_rng([self.config.seed, t // MILLISECOND])
            depth = measured_depth(depth, render.cosine, render.grey, self.config.camera, sensor, rng)
        units = np.rint(depth.astype(np.float64) * DEPTH_UNITS_PER_METRE)
        units[units > np.iinfo(np.uint16).max] = 0
        _write_png(self.folder / _frame_name(t), units.astype(np.uint16))


def _displacement(sensor: DepthSensor) -> np.ndarray:  # [4, 4]
    """Return where the depth sensor stands in the frame of the place its calibration states."""
    T = np.eye(4)
    axis = np.array([0.6, 0.64, 0.48])  # oblique, so that every direction takes part; of length 1
    T[:3, :3] = Rotation.from_rotvec(np.radians(sensor.rotation) * axis).as_matrix()
    T[:3, 3] = sensor.translation * axis[[2, 0, 1]]
    return T


def _frame_name(t: int) -> str:
    return f"frame{t // MILLISECOND:06d}.png"


def _write_png(path: Path, image: np.ndarray) -> None:
    import cv2

    if not cv2.imwrite(str(path), image):
        raise DataError(f"{path}: could not be written; is the disk full?")
