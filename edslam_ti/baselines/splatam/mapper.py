"""Mapping of SplaTAM (Sec. 3.3): Gaussians where the map lacks a frame, optimised with old keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from edslam_ti.baselines.splatam.gaussian_map import IsotropicMap, activated, no_rotation
from edslam_ti.baselines.splatam.similarity import Similarity, Target
from edslam_ti.baselines.splatam.views import Scale
from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.frame import Frame
from edslam_ti.geometry import inverse
from edslam_ti.mapping.gaussian_ply import write_gaussian_ply
from edslam_ti.mapping.mapper import Progress
from edslam_ti.mapping.rendering import RenderOutput, View, median_depth
from edslam_ti.trajectory import Trajectory

OVERLAP_PIXELS = 1600  # of a frame, by which its overlap with keyframes is measured
BORDER = 1 / 60  # of the image's width; projections nearer to the border do not count as overlap
SCENE_SHARE = 1 / 3  # of the largest depth of the first frame: the scene's radius
SMOOTHING = 0.95  # of the running mean of the loss


@dataclass(frozen=True)
class Observation:
    """A frame that the map is optimised for."""

    index: int  # in the trajectory
    image: Tensor  # [H, W] in [0, 1]
    depth: Tensor  # [H, W] metres, 0 = missing


@dataclass(frozen=True)
class Selected:
    """A view of one frame's optimisation."""

    T_camera_world: Tensor  # [4, 4] float32
    target: Target
    depth: Tensor  # [H, W] metres, 0 = missing
    has_depth: Tensor  # [H, W] bool
    num_measured: Tensor  # scalar


class SplatamMapper:
    """Adds and optimises isotropic Gaussians after every frame (Mapper)."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self.loss = float("nan")  # running mean
        self.num_steps = 0  # taken so far
        self._gaussians = IsotropicMap()
        self._config = config.splatam.mapping
        self._ply_harmonics = config.mapping.ply_harmonics
        self._scale = Scale(camera, self._config.image_width, self._gaussians.device)
        self._rays = self._scale.rays()
        self._similarity = Similarity(*self._scale.camera.shape, self._gaussians.device)
        self._generator = torch.Generator().manual_seed(config.seed + 1)
        self._keyframes: list[Observation] = []
        self._num_mapped = 0
        self._scene_radius = 0.0  # metres

    @property
    def num_gaussians(self) -> int:
        return len(self._gaussians)

    # --- the loop ---

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Add Gaussians for the newest frame and optimise; nothing for a frame held out or incomplete."""
        if frame.is_held_out or frame.depth is None or frame.image is None:
            return
        new = Observation(len(trajectory) - 1, self._scale.image(frame.image), self._scale.depth(frame.depth))
        if not bool(new.depth.any()):
            return
        if self._num_mapped == 0:
            self._scene_radius = SCENE_SHARE * float(new.depth.max())
        self._grow(new, trajectory)
        if len(self._gaussians):
            self._optimise(new, trajectory)
        if self._num_mapped % self._config.keyframe_every == 0:
            self._keyframes.append(new)
        self._num_mapped += 1

    def forget_depth(self, frames: Sequence[int], trajectory: Trajectory) -> None:
        """Leave the map as it is: its tracker distrusts new frames only, and those are not mapped."""

    def finish(self, trajectory: Trajectory, progress: Progress) -> None:
        """Do nothing: the authors refine no finished map."""
        progress(1.0)

    # --- what the map shows ---

    @torch.no_grad()
    def render(self, camera: Camera, T_world_camera: np.ndarray, measured_only: bool = False) -> View:
        """Return the map seen from a pose, on black."""
        scale = Scale(camera, camera.width, self._gaussians.device)
        T = torch.from_numpy(T_world_camera).to(scale.device)
        T_camera_world = inverse(T).float()
        shown = self._gaussians.activated(scale.in_view(self._gaussians, T_camera_world))
        drawn = scale.render(shown, T_camera_world)
        brightness = drawn.image[..., 0].clamp(0, 1)
        output = RenderOutput(brightness, drawn.depth, drawn.alpha, drawn.visible, drawn.dominant)
        depth = median_depth(shown, output, T)
        return View(brightness.cpu().numpy(), depth.cpu().numpy(), drawn.alpha.cpu().numpy())

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gaussians' centres and brightness."""
        raw = self._gaussians.raw
        return raw["means"].cpu().numpy(), raw["colors"][:, 0].clamp(0, 1).cpu().numpy()

    @property
    def map(self) -> IsotropicMap:
        """The Gaussians."""
        return self._gaussians

    def keyframe_indices(self) -> list[int]:
        """Return the frames kept as keyframes."""
        return [keyframe.index for keyframe in self._keyframes]

    def metrics(self) -> dict[str, int | float | None]:
        """Return the numbers of keyframes and of optimisation steps."""
        return {"num_keyframes": len(self._keyframes), "num_mapping_steps": self.num_steps}

    def save(self, folder: Path) -> None:
        """Write map.ply, the Gaussians in the layout of 3D Gaussian splatting."""
        raw = {name: value.cpu().numpy() for name, value in self._gaussians.raw.items()}
        log_scales = np.repeat(raw["log_scales"], 3, axis=1)
        quats = no_rotation(torch.from_numpy(log_scales)).numpy()
        colors = np.clip(raw["colors"], 0, 1)
        write_gaussian_ply(
            folder / "map.ply",
            raw["means"],
            quats,
            log_scales,
            raw["logit_opacities"],
            colors,
            self._ply_harmonics,
        )

    # --- growing ---

    @torch.no_grad()
    def _grow(self, new: Observation, trajectory: Trajectory) -> None:
        """Add a Gaussian at every pixel that the map does not show, or shows behind what was measured."""
        config, stride = self._config, self._config.pixel_stride
        T = self._pose(new.index, trajectory)
        T_camera_world = inverse(T).float()
        chosen = self._scale.in_view(self._gaussians, T_camera_world)
        view = self._scale.render(self._gaussians.activated(chosen), T_camera_world)
        has_depth = new.depth > 0
        error = torch.where(has_depth, (view.depth - new.depth).abs(), 0)
        is_behind = (view.depth > new.depth) & (error > config.depth_error_factor * error.median())
        lacks = has_depth & ((view.alpha < config.min_silhouette) | is_behind)
        # One Gaussian for a block of pixels; the phase keeps the grid in the middle of the blocks.
        grid = torch.zeros_like(lacks)
        grid[stride // 2 :: stride, stride // 2 :: stride] = True
        mask = lacks & grid
        depth = new.depth[mask]
        points = self._rays[mask] * depth[:, None]
        means = points @ T[:3, :3].float().T + T[:3, 3].float()
        focal_length = 0.5 * (self._scale.camera.fx + self._scale.camera.fy)
        scales = config.initial_size * stride * depth / focal_length
        self._gaussians.add(means, scales, config.initial_opacity, new.image[mask])

    # --- optimising ---

    def _optimise(self, new: Observation, trajectory: Trajectory) -> None:
        """Optimise the Gaussians in view for the newest frame and keyframes that overlap with it.

        The optimiser begins anew with every frame, as the authors' does. So Gaussians out of all these views
        would not move, and cost nothing here.
        """
        config = self._config
        views = [self._selected(o, trajectory) for o in self._overlapping(new, trajectory)]
        chosen = self._in_any(views)
        leaves = self._gaussians.leaves(chosen)
        adam = self._optimiser(leaves)
        total = torch.zeros((), device=self._gaussians.device)
        for step in range(config.iterations):
            k = int(torch.randint(len(views), (), generator=self._generator))
            loss = self._loss(leaves, views[k])
            loss.backward()
            total += loss.detach()
            if step % config.prune_every == 0 and step <= config.prune_until:
                chosen, leaves, adam = self._pruned(chosen, leaves, adam)
            adam.step()
            adam.zero_grad(set_to_none=True)
        self.num_steps += config.iterations
        self._gaussians.overwrite(chosen, leaves)
        if config.iterations:
            mean = float(total) / config.iterations
            self.loss = mean if np.isnan(self.loss) else SMOOTHING * self.loss + (1 - SMOOTHING) * mean

    def _loss(self, leaves: dict[str, Tensor], view: Selected) -> Tensor:
        """Return the weighted sum of the mean error of depth and the error of brightness."""
        config = self._config
        drawn = self._scale.render(activated(leaves), view.T_camera_world)
        image = drawn.image[..., 0]
        error = torch.where(view.has_depth, (drawn.depth - view.depth).abs(), 0).sum() / view.num_measured
        colour = (1 - config.similarity_weight) * (image - view.target.image).abs().mean()
        if config.similarity_weight > 0:
            colour = colour + config.similarity_weight * (1 - self._similarity(image, view.target))
        return config.image_weight * colour + config.depth_weight * error

    def _optimiser(self, leaves: dict[str, Tensor]) -> torch.optim.Adam:
        config = self._config
        rates = {
            "means": config.means_rate,
            "log_scales": config.scales_rate,
            "logit_opacities": config.opacities_rate,
            "colors": config.colors_rate,
        }
        groups = [{"params": [leaves[name]], "lr": rate} for name, rate in rates.items()]
        return torch.optim.Adam(groups, eps=1e-15, fused=True)

    def _pruned(
        self, chosen: Tensor, leaves: dict[str, Tensor], adam: torch.optim.Adam
    ) -> tuple[Tensor, dict[str, Tensor], torch.optim.Adam]:
        """Remove faint and huge Gaussians; the others keep their gradients and moments."""
        config = self._config
        with torch.no_grad():
            largest = config.max_size * self._scene_radius
            keep = leaves["logit_opacities"].sigmoid() >= config.min_opacity
            keep &= leaves["log_scales"][:, 0].exp() <= largest
            if bool(keep.all()):
                return chosen, leaves, adam
            self._gaussians.overwrite(chosen, leaves)
            kept = torch.ones(len(self._gaussians), dtype=torch.bool, device=keep.device)
            kept[chosen] = keep
            self._gaussians.keep(kept)
            number = torch.cumsum(kept, 0) - 1  # new indices
            remaining = number[chosen[keep]]
        new = self._gaussians.leaves(remaining)
        again = self._optimiser(new)
        for name, value in new.items():
            gradient = leaves[name].grad
            value.grad = None if gradient is None else gradient[keep]
            again.state[value] = {
                key: state[keep] if state.shape else state for key, state in adam.state[leaves[name]].items()
            }
        return remaining, new, again

    # --- views ---

    def _pose(self, index: int, trajectory: Trajectory) -> Tensor:  # [4, 4] float64
        return torch.from_numpy(trajectory.pose(index)).to(self._gaussians.device)

    def _selected(self, observation: Observation, trajectory: Trajectory) -> Selected:
        has_depth = observation.depth > 0
        return Selected(
            inverse(self._pose(observation.index, trajectory)).float(),
            self._similarity.target(observation.image),
            observation.depth,
            has_depth,
            has_depth.sum().clamp_min(1),
        )

    def _in_any(self, views: list[Selected]) -> Tensor:  # [M] indices
        """Return the Gaussians that may show in any of the views."""
        is_in_view = torch.zeros(len(self._gaussians), dtype=torch.bool, device=self._gaussians.device)
        for view in views:
            is_in_view[self._scale.in_view(self._gaussians, view.T_camera_world)] = True
        return torch.nonzero(is_in_view).squeeze(1)

    def _overlapping(self, new: Observation, trajectory: Trajectory) -> list[Observation]:
        """Return random keyframes that overlap with the newest frame, then the last one and the newest."""
        if not self._keyframes:
            return [new]
        *older, last = self._keyframes
        seen = [o for o, share in zip(older, self._shares(new, older, trajectory)) if share > 0]
        order = torch.randperm(len(seen), generator=self._generator).tolist()
        return [*(seen[k] for k in order[: self._config.window - 2]), last, new]

    @torch.no_grad()
    def _shares(self, new: Observation, keyframes: list[Observation], trajectory: Trajectory) -> list[float]:
        """Return for each keyframe the share of the newest frame's points that it sees."""
        if not keyframes:
            return []
        rows, columns = torch.nonzero(new.depth > 0, as_tuple=True)
        drawn = torch.randint(len(rows), (OVERLAP_PIXELS,), generator=self._generator).to(rows.device)
        v, u = rows[drawn], columns[drawn]
        points = self._rays[v, u] * new.depth[v, u][:, None]
        T = inverse(torch.stack([self._pose(o.index, trajectory) for o in keyframes]))
        T = (T @ self._pose(new.index, trajectory)).float()  # of the newest frame in each keyframe
        x, y, z = (points @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]).unbind(-1)  # [K, P]
        camera = self._scale.camera
        border = BORDER * camera.width
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (u > border) & (u < camera.width - border) & (v > border) & (v < camera.height - border)
        shares: list[float] = (inside & (z > 0)).float().mean(1).tolist()
        return shares
