"""The event loss between two renders, Eq. 9 to 12, at any two moments of the path."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from edslam_ti.camera import Camera
from edslam_ti.geometry import interpolate, inverse, se3_exp
from edslam_ti.kernels.projection import LOW_PASS
from edslam_ti.kernels.view_losses import Comparison, compare_change
from edslam_ti.mapping.gaussians import Gaussians
from edslam_ti.mapping.rendering import render
from edslam_ti.trajectory import Trajectory


class PathPoses:
    """Poses at some moments between key poses (Eq. 9), differentiable in small motions of those."""

    def __init__(
        self,
        trajectory: Trajectory,
        times: Sequence[float],  # seconds
        free: range | None,  # frames whose poses may move; the first frame defines the world; None: no frame
    ) -> None:
        self._deltas: dict[int, Tensor] = {}  # [6] by frame
        poses = [self._at(trajectory, time, free) for time in times]
        self.T_world_camera = torch.stack(poses)  # [K, 4, 4] float64

    def _at(self, trajectory: Trajectory, time: float, free: range | None) -> Tensor:
        if len(trajectory) == 1:
            return self._key(trajectory, 0, free)
        k = min(max(trajectory.index_of(time), 0), len(trajectory) - 2)
        start, end = trajectory.timestamp(k), trajectory.timestamp(k + 1)
        fraction = (time - start) / (end - start)
        if abs(fraction) < 1e-9:
            return self._key(trajectory, k, free)
        if abs(fraction - 1) < 1e-9:
            return self._key(trajectory, k + 1, free)
        return interpolate(self._key(trajectory, k, free), self._key(trajectory, k + 1, free), fraction)

    def _key(self, trajectory: Trajectory, index: int, free: range | None) -> Tensor:  # [4, 4]
        T = torch.from_numpy(trajectory.pose(index))
        if free is None or index == 0 or index not in free:
            return T
        if index not in self._deltas:
            self._deltas[index] = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        return T @ se3_exp(self._deltas[index])

    def gradients(self) -> dict[int, np.ndarray]:  # [6] by frame
        """Return the loss's gradient in the twist of each free pose, after `backward`."""
        return {k: delta.grad.numpy() for k, delta in self._deltas.items() if delta.grad is not None}


@dataclass(frozen=True)
class Reduction:
    """A camera reduced by a power of two, and the map's blur that goes with it."""

    camera: Camera
    factor: int

    @staticmethod
    def of(camera: Camera, level: int) -> "Reduction":
        """Return the reduction by 2^level; level 0 leaves images as they are."""
        return Reduction(camera.downscaled(1 << level) if level else camera, 1 << level)

    def reduced(self, image: Tensor) -> Tensor:  # [H, W] -> [h, w]
        """Return the means of blocks; odd edges are cut off."""
        if self.factor == 1:
            return image
        return torch.nn.functional.avg_pool2d(image[None, None], self.factor)[0, 0].contiguous()

    @property
    def low_pass(self) -> float:
        """Pixels^2 added to every 2D covariance: the same blur on the full image."""
        return LOW_PASS / self.factor**2


def change_loss(
    gaussians: Gaussians,
    T_world_camera: Tensor,  # [2, 4, 4] at the start and at the end
    change: Tensor,  # [H, W] measured change of log brightness, Eq. 11
    reduction: Reduction,
    background: float,
    epsilon: float,
) -> Comparison:
    """Return the mean squared error of the change between two renders, Eq. 10 to 12."""
    target, camera = reduction.reduced(change), reduction.camera
    return compare_change(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors,
        inverse(T_world_camera).float(), camera.intrinsics, (camera.width, camera.height),
        target, background, epsilon, 1 / target.numel(), low_pass=reduction.low_pass,
    )  # fmt: skip


def depth_loss(
    gaussians: Gaussians,
    camera: Camera,
    T_world_camera: Tensor,  # [4, 4]
    depth: Tensor,  # [H, W] metres, 0 = missing
    background: float,
) -> Tensor:
    """Return Eq. 15: the mean of |rendered - measured| over the pixels with depth.

    Rendered depth is Eq. 8's sum, in which transparency counts as nearness.
    """
    error = (render(gaussians, camera, T_world_camera, background).depth - depth).abs()
    is_measured = depth > 0
    return (error * is_measured).sum() / is_measured.sum().clamp_min(1)
