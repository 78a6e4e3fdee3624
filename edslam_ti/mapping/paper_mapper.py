"""The paper's mapper, Eq. 10 to 16: Gaussians at measured depth explain the change between two renders.

A loss compares two renders at nearby moments with the events in between (Eq. 12), adds Eq. 14 and Eq. 15, and
weighs them as in Sec. IV-A. Only keyframes, with the chunks around them, and the newest chunks are kept.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.frame import Frame
from edslam_ti.mapping.change_loss import depth_loss
from edslam_ti.mapping.change_mapper import ChangeMapper
from edslam_ti.mapping.gaussians import GaussianMap, Gaussians
from edslam_ti.mapping.insertion import new_gaussians
from edslam_ti.trajectory import Trajectory


@dataclass(frozen=True)
class _DepthKeyframe:
    """A keyframe as Sec. III-E stores it; its pose is on the trajectory, its events are in the sums."""

    index: int  # frame
    depth: np.ndarray  # [H, W] metres, 0 = missing


class PaperMapper(ChangeMapper):
    """Adds Gaussians where Eq. 13 says, and minimises Eq. 16 over map and poses (Mapper)."""

    def __init__(self, camera: Camera, contrast: ContrastThreshold, config: Config) -> None:
        super().__init__(camera, contrast, config)
        self._keyframes: list[_DepthKeyframe] = []

    def keyframe_indices(self) -> list[int]:
        """Return the frames chosen as keyframes."""
        return [keyframe.index for keyframe in self._keyframes]

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Add the frame's events and Gaussians, then optimise."""
        self.budget.start(frame.timestamp)
        index = self._num_frames
        self._num_frames += 1
        self._sums.add(frame, index)
        if frame.depth is not None and not frame.is_held_out:
            self._add_depth(frame.depth, index, trajectory)
        self._drop_surplus(index)
        if not frame.is_held_out and len(self.gaussians) > 0:
            self._optimise_online(trajectory)
        self.budget.stop()

    def _add_depth(self, depth: np.ndarray, index: int, trajectory: Trajectory) -> None:
        """Add Gaussians where Eq. 13 says, and a keyframe if the frame sees enough that is new."""
        T, config = trajectory.pose(index), self._config
        view = self._view(T)
        last = trajectory.pose(self._keyframes[-1].index) if self._keyframes else None
        if last is None or self._sees_enough_new(view, depth, T, last):
            self._keyframes.append(_DepthKeyframe(index, depth))
        alpha, rendered_depth = view.alpha.numpy(), view.expected_depth.numpy()
        new = new_gaussians(depth, alpha, rendered_depth, self._camera, T, len(self.gaussians), config)
        if new is None:
            return
        x, y = (torch.from_numpy(k) for k in new.pixels.T)
        # What shines through has the brightness of its surroundings; where nothing is drawn, it is unknown.
        brightness = view.intensity[y, x]
        self.gaussians.add(
            torch.from_numpy(new.means),
            torch.from_numpy(new.quats),
            torch.from_numpy(new.scales),
            config.initial_opacity,
            brightness[:, None],
            index,
            torch.from_numpy(new.is_measured),
        )

    def _drop_surplus(self, newest: int) -> None:
        """Keep the newest N chunks, and the N around every keyframe (N = 5, Sec. III-E)."""
        number = self._keyframe_config.num_chunks
        old = newest - number
        is_near = any(abs(keyframe.index - old) <= number // 2 for keyframe in self._keyframes[-2:])
        if old in self._sums.frames and not is_near:
            self._sums.drop(old)
        while len(self._sums.frames) > self._config.max_views:
            older = self._keyframes[: max(1, len(self._keyframes) // 2)]
            gone = older[len(older) // 2]
            self._keyframes.remove(gone)
            for k in self._sums.frames:
                if abs(k - gone.index) <= number // 2 and k < newest - number:
                    self._sums.drop(k)
            if len(self._keyframes) < 2:
                break

    def _other_losses(self, subset: GaussianMap, active: Gaussians, trajectory: Trajectory) -> Tensor:
        """Return Eq. 14, and Eq. 15 at a random keyframe, weighted."""
        regularised = super()._other_losses(subset, active, trajectory)
        if not self._keyframes or self._config.depth_weight == 0:
            return regularised
        keyframe = self._keyframes[int(self._random.integers(len(self._keyframes)))]
        T = torch.from_numpy(trajectory.pose(keyframe.index))
        depth = torch.from_numpy(keyframe.depth)
        error = depth_loss(active, self._camera, T, depth, self._config.background)
        return regularised + self._config.depth_weight * error
