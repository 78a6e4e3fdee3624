"""Tracking of SplaTAM (Sec. 3.3): a pose is found by the error of the render where the map is known."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from edslam_ti.baselines.splatam.gaussian_map import IsotropicMap
from edslam_ti.baselines.splatam.views import Scale
from edslam_ti.camera import Camera
from edslam_ti.frame import Frame
from edslam_ti.geometry import inverse, orthonormalized, se3_exp
from edslam_ti.kernels.rasterization import Rasterization
from edslam_ti.mapping.gaussians import Gaussians
from edslam_ti.rgbd_config import SplatamConfig
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.trajectory import Trajectory

CHANNELS = 3  # a grey image counts as three equal channels: the authors' loss sums over three


@dataclass(frozen=True)
class Alignment:
    """The best pose of a frame, and how well the map explains the frame from there."""

    T_world_camera: np.ndarray  # [4, 4]
    agreement: float  # share of the pixels with depth whose depth is that of the map, 0 to 1


class SplatamTracker:
    """Moves the camera until the render of the map resembles the frame (Tracker)."""

    def __init__(self, camera: Camera, gaussians: IsotropicMap, config: SplatamConfig) -> None:
        """`gaussians`: the mapper's map."""
        self._map = gaussians
        self._config = config.tracking
        self._scale = Scale(camera, config.tracking.image_width, gaussians.device)
        self._last: np.ndarray | None = None  # [4, 4] the last pose that was found

    def track(self, frame: Frame, T_world_camera_guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the pose of `frame`; where it cannot be found, the guess, marked as lost."""
        problem, found = self._found(frame, T_world_camera_guess)
        if problem or found is None:
            # Kept from the map, which a wrong pose would spoil.
            quality, lost = 0.0 if found is None else found.agreement, (len(trajectory),)
            message = f"{problem}: pose predicted"
            return TrackingResult(T_world_camera_guess, False, quality, message, distrusted=lost)
        self._last = orthonormalized(found.T_world_camera)
        return TrackingResult(self._last, True, found.agreement)

    def consistency(self, trajectory: Trajectory) -> None:
        """Return None: it does not compare its data."""

    def _found(self, frame: Frame, T_guess: np.ndarray) -> tuple[str, Alignment | None]:
        """Return why the frame is lost, if so, and the best alignment, if any was tried.

        A frame that does not fit from the predicted pose is aligned again from the last pose that was found:
        the camera may have stopped.
        """
        if frame.depth is None or frame.image is None:
            return f"no {'depth image' if frame.depth is None else 'image'} at this time", None
        image, depth = self._scale.image(frame.image), self._scale.depth(frame.depth)
        if not bool(depth.any()):
            return "depth at no pixel", None
        if len(self._map) == 0:
            return "", Alignment(T_guess, 1.0)  # the map begins with this frame
        found, least = self._aligned(image, depth, T_guess), self._config.min_agreement
        if found.agreement < least and self._last is not None:
            again = self._aligned(image, depth, self._last)
            found = again if again.agreement > found.agreement else found
        problem = f"the map explains only {found.agreement:.0%} of the depth"
        return "" if found.agreement >= least else problem, found

    def _aligned(
        self,
        image: Tensor,  # [H, W]
        depth: Tensor,  # [H, W] metres, 0 = missing
        T_guess: np.ndarray,  # [4, 4]
    ) -> Alignment:
        """Descend along the gradient of the twist xi in T exp(xi), and return the best pose on the way."""
        config, device = self._config, image.device
        start = torch.from_numpy(T_guess).to(device)
        chosen = self._scale.in_view(self._map, inverse(start).float())
        gaussians = self._map.activated(chosen)
        shift, turn = (torch.zeros(3, dtype=start.dtype, device=device, requires_grad=True) for _ in range(2))
        groups = [
            {"params": [shift], "lr": config.translation_rate},
            {"params": [turn], "lr": config.rotation_rate},
        ]
        adam = torch.optim.Adam(groups)
        best, least = start, torch.tensor(torch.inf, device=device)
        for _ in range(config.iterations):
            T = start @ se3_exp(torch.cat([shift, turn]))
            loss = self._loss(self._scale.render(gaussians, inverse(T).float()), image, depth)
            adam.zero_grad()
            loss.backward()
            is_better = loss.detach() < least  # chosen on the device: no step waits for the last one
            best = torch.where(is_better, T.detach(), best)
            least = torch.where(is_better, loss.detach(), least)
            adam.step()
        return Alignment(best.cpu().numpy(), self._agreement(gaussians, best, depth))

    def _loss(self, view: Rasterization, image: Tensor, depth: Tensor) -> Tensor:
        """Return Eq. 8: errors of depth and brightness where the silhouette is sure."""
        config = self._config
        mask = (view.alpha.detach() > config.min_silhouette) & (depth > 0)
        colour, error = (view.image[..., 0] - image).abs(), (view.depth - depth).abs()
        total = config.image_weight * CHANNELS * colour + config.depth_weight * error
        return torch.where(mask, total, 0).sum()

    @torch.no_grad()
    def _agreement(self, gaussians: Gaussians, T_world_camera: Tensor, depth: Tensor) -> float:
        view = self._scale.render(gaussians, inverse(T_world_camera).float())
        is_known, is_near = view.alpha > 0.5, (view.depth / view.alpha.clamp_min(0.5) - depth).abs()
        agrees = is_known & (is_near < self._config.max_depth_difference) & (depth > 0)
        return float(agrees.sum() / (depth > 0).sum().clamp_min(1))
