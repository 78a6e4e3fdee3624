"""The interface of mappers."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.frame import Frame
from edslam_ti.mapping.rendering import View
from edslam_ti.trajectory import Trajectory

Progress = Callable[[float], bool]  # receives the fraction done, 0 to 1; returns False to stop


class Mapper(Protocol):
    """Builds a map from tracked frames and renders it. The rest of the package uses nothing else of it."""

    # --- during a run ---

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Add the newest frame, whose pose is the trajectory's last; may correct earlier poses.

        It must not use the depth and the image of a frame with `is_held_out`.
        """

    def forget_depth(self, frames: Sequence[int], trajectory: Trajectory) -> None:
        """Take out what earlier frames' depth has added: it has turned out to be wrong."""

    def finish(self, trajectory: Trajectory, progress: Progress) -> None:
        """Refine the map after the last frame; may correct poses."""

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians; 0 for other kinds of maps."""

    @property
    def loss(self) -> float:
        """Running mean of the loss; nan if the mapper minimises none."""

    # --- what the map shows ---

    def render(self, camera: Camera, T_world_camera: np.ndarray, measured_only: bool = False) -> View:
        """Return the map seen from a pose [4, 4]; `measured_only`: without surfaces at assumed depth."""

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return points [N, 3] (metres, world) and their brightness [N] in [0, 1]."""

    def keyframe_indices(self) -> list[int]:
        """Return the indices of keyframes, for viewers; empty for a map without keyframes."""

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
        """The object that holds the map itself; its memory is reported separately from the mapper's."""
