"""What every Gaussian map shows and saves, however it was optimised."""

from pathlib import Path

import numpy as np
import torch

from edslam_ti.camera import Camera
from edslam_ti.config import MappingConfig
from edslam_ti.mapping.gaussian_ply import write_gaussian_ply
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.rendering import RenderOutput, View, render_map, render_view


class ShownMap:
    """A Gaussian map and its views: that part of `Mapper` which all Gaussian mappers share."""

    def __init__(self, camera: Camera, config: MappingConfig) -> None:
        self.gaussians = GaussianMap(config)
        self._camera = camera
        self._config = config

    @property
    def num_gaussians(self) -> int:
        return len(self.gaussians)

    @property
    def map(self) -> GaussianMap:
        """The Gaussians."""
        return self.gaussians

    def render(self, camera: Camera, T_world_camera: np.ndarray, measured_only: bool = False) -> View:
        """Return the map seen from a pose; `measured_only`: without Gaussians at assumed depth."""
        gaussians = self.gaussians.measured() if measured_only else self.gaussians
        return render_view(gaussians, camera, T_world_camera, self._config.background)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gaussians' centres and brightness."""
        with torch.no_grad():
            gaussians = self.gaussians.activated()
        return gaussians.means.detach().numpy(), gaussians.colors.numpy()[:, 0]

    def save(self, folder: Path) -> None:
        """Write map.ply, the Gaussians in the layout of 3D Gaussian splatting."""
        raw = {name: value.detach().numpy() for name, value in self.gaussians.raw.items()}
        colors = self.gaussians.activated().colors.detach().numpy()
        write_gaussian_ply(
            folder / "map.ply",
            raw["means"],
            raw["quats"],
            raw["log_scales"],
            raw["logit_opacities"],
            colors,
            self._config.ply_harmonics,
        )

    def _view(self, T_world_camera: np.ndarray) -> RenderOutput:  # [4, 4]
        return render_map(self.gaussians, self._camera, T_world_camera, self._config.background)
