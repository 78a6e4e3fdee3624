"""What a mapper is."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.frame import Frame
from edslam_ti.mapping.rendering import View
from edslam_ti.trajectory import Trajectory

Progress = Callable[[float], bool]  # told the fraction done, 0 to 1; False asks to stop


class Mapper(Protocol):
    """Builds a map from tracked frames and shows it. This is all that the rest of the package knows of it."""

    # --- during a run ---

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Add the newest frame, whose pose ends the trajectory; may correct earlier poses.

        The depth and the image of a frame with `is_held_out` must not be used.
        """

    def forget_depth(self, frames: Sequence[int], trajectory: Trajectory) -> None:
        """Take out what earlier frames' depth has added: it has turned out to be wrong."""

    def finish(self, trajectory: Trajectory, progress: Progress) -> None:
        """Refine the map after the last frame; may correct poses."""

    @property
    def num_gaussians(self) -> int:
        """Size of the map; 0 for maps of another kind."""

    @property
    def loss(self) -> float:
        """Running mean of what is minimised; nan where nothing is."""

    # --- what the map shows ---

    def render(self, camera: Camera, T_world_camera: np.ndarray, measured_only: bool = False) -> View:
        """Return the map seen from a pose [4, 4]; `measured_only`: without surfaces that are assumed."""

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return points [N, 3] (metres, world) and their brightness [N] in [0, 1]."""

    def keyframe_indices(self) -> list[int]:
        """Return the frames that the map is built on, for viewers; empty for a map without keyframes."""

    # --- results ---

    def metrics(self) -> dict[str, int | float | None]:
        """Return the map's part of metrics.json.

        `num_keyframes`, `num_mapping_steps` and `num_hot_pixels` are written as null where they are left out;
        other names are written, too.
        """

    def save(self, folder: Path) -> None:
        """Write the map's own files into a results folder; points and mesh are written for every mapper."""

    @property
    def map(self) -> object:
        """The object that holds the map itself, whose memory is reported apart from the mapper's."""
