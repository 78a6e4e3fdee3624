"""What a mapper is."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.frame import Frame
from edslam_ti.mapping.rendering import View
from edslam_ti.trajectory import Trajectory

Progress = Callable[[float], bool]  # told the fraction done, 0 to 1; False asks to stop


class Mapper(Protocol):
    """Builds a map from tracked frames and shows it."""

    @property
    def num_gaussians(self) -> int:
        """Size of the map; 0 for maps of another kind."""

    @property
    def loss(self) -> float:
        """Running mean of what is minimised; nan where nothing is."""

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Take in the newest frame, whose pose ends the trajectory; may correct earlier poses."""

    def finish(self, trajectory: Trajectory, progress: Progress) -> None:
        """Last refinement after the last frame; may correct poses."""

    def render(self, camera: Camera, T_world_camera: np.ndarray, measured_only: bool = False) -> View:
        """Return the map seen from a pose [4, 4]; `measured_only`: without surfaces that are assumed."""

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return points [N, 3] (metres, world) and their brightness [N] in [0, 1]."""
