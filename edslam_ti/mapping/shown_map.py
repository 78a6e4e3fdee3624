"""What every Gaussian map shows and saves, however it was optimised."""

from pathlib import Path

import numpy as np
import torch

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.mapping.gaussian_ply import write_gaussian_ply
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.keyframes import covisibility, is_keyframe
from edslam_ti.mapping.rendering import RenderOutput, View, render_map, render_view


class ShownMap:
    """A Gaussian map and its views: that part of `Mapper` which all Gaussian mappers share."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self.gaussians = GaussianMap(config.mapping)
        self._camera = camera
        self._config = config.mapping
        self._keyframe_config = config.keyframes

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

    def _sees_enough_new(
        self,
        view: RenderOutput,  # of the frame
        depth: np.ndarray,  # [H, W] metres, 0 = missing
        T_world_camera: np.ndarray,  # [4, 4] of the frame
        T_world_keyframe: np.ndarray,  # [4, 4] of the last keyframe
    ) -> bool:
        """Return whether a frame becomes a keyframe (Sec. III-E)."""
        shared = covisibility(view.visible, self._view(T_world_keyframe).visible)
        translation = float(np.linalg.norm(T_world_camera[:3, 3] - T_world_keyframe[:3, 3]))
        measured = depth[depth > 0]
        median_depth = float(np.median(measured)) if len(measured) else np.inf
        return is_keyframe(shared, translation, median_depth, self._keyframe_config)
