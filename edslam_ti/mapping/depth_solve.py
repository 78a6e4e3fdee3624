"""The depth of all Gaussians at once, from the event loss between many pairs of renders.

Gradient steps move a Gaussian by millimetres, however far it is from the surface. For fixed brightness the
loss is nearly linear in small motions along the rays. A pixel shows one Gaussian above all. Where that
moves by the share delta of its distance from the middle of the path, the log brightness L changes by -grad
L . j delta, with j the motion of its image. A pair of views a, b says

    -(grad L_b . j_b) delta[seen at b] + (grad L_a . j_a) delta[seen at a] = measured - rendered change

(Eq. 10 to 12, one row per pixel). Conjugate gradients solve it; the result is a Gauss-Newton step of the
loss. Gaussians of a cell, as seen from the middle of the path, move together: a surface is smooth, and its
events are at its edges. Images are reduced, so that motions of some pixels are small.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from edslam_ti.mapping.brightness_solve import HUBER, Pair, conjugate_gradients
from edslam_ti.mapping.change_loss import Reduction
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.rendering import RenderOutput

HOLD = 200.0  # sum of squared slopes that holds a cell in place as firmly as events move it
FARTHEST = 0.15  # of its distance: a Gaussian moves by no more at once, because brightness is not linear
ROUGH = 0.05  # log brightness a pixel and unit of delta; weaker slopes are noise


@dataclass(frozen=True)
class SeenFrom:
    """A view and where it is from."""

    view: RenderOutput  # of the reduced camera
    T_camera_world: Tensor  # [4, 4] float32


@torch.no_grad()
def solve_depth(
    gaussians: GaussianMap,  # of N
    seen: Sequence[SeenFrom],
    pairs: Sequence[Pair],  # their changes at full size
    reduction: Reduction,
    epsilon: float,
    cell: float,  # radians seen from the middle of the path; Gaussians of a cell move together
    iterations: int,
) -> None:
    """Move the Gaussians along the rays from the middle of the path."""
    centre = torch.stack([-(s.T_camera_world[:3, :3].T @ s.T_camera_world[:3, 3]) for s in seen]).mean(0)
    means = gaussians.raw["means"].detach()
    logs = [(s.view.intensity + epsilon).log() for s in seen]
    slopes = [_slopes(s, log, means, centre, reduction) for s, log in zip(seen, logs)]
    shown = [s.view.dominant.reshape(-1).long() for s in seen]
    parts: list[tuple[Tensor, ...]] = []
    for pair in pairs:
        a, b = shown[pair.start], shown[pair.end]
        residual = reduction.reduced(pair.change) - (logs[pair.end] - logs[pair.start])
        used = (a >= 0) & (b >= 0)
        row = (a, b, -slopes[pair.start], slopes[pair.end], residual.reshape(-1))
        parts.append(tuple(part[used] for part in row))
    first, second, of_first, of_second, residual = (torch.cat(part) for part in zip(*parts))
    weight = (HUBER / residual.abs().clamp_min(1e-6)).clamp_max(1.0)
    away = means - centre
    directions = torch.floor(away / away.norm(dim=1, keepdim=True) / cell).long()
    _, cells = torch.unique(directions, dim=0, return_inverse=True)
    first, second = cells[first], cells[second]
    factors, number = (of_first, of_second), int(cells.max()) + 1
    delta, _ = conjugate_gradients(first, second, factors, weight, residual, number, HOLD, iterations)
    factor = 1 + delta[cells].clamp(-FARTHEST, FARTHEST)
    everyone = torch.arange(len(means))
    gaussians.overwrite("means", everyone, centre + (means - centre) * factor[:, None])
    scales = gaussians.raw["log_scales"].detach() + factor.log()[:, None]
    gaussians.overwrite("log_scales", everyone, scales)


def _slopes(s: SeenFrom, log: Tensor, means: Tensor, centre: Tensor, reduction: Reduction) -> Tensor:
    """Return [h w], the change of log brightness at each pixel by delta of the Gaussian that it shows."""
    down, across = torch.gradient(log)
    shown = s.view.dominant.reshape(-1).long().clamp_min(0)
    T, camera = s.T_camera_world, reduction.camera
    p = means.index_select(0, shown)
    x, y, z = (p @ T[:3, :3].T + T[:3, 3]).unbind(-1)
    u, v, w = ((p - centre) @ T[:3, :3].T).unbind(-1)
    near = z.clamp_min(0.05)
    motion_x = camera.fx * (u - x / near * w) / near
    motion_y = camera.fy * (v - y / near * w) / near
    slope = -(across.reshape(-1) * motion_x + down.reshape(-1) * motion_y)
    return torch.where(slope.abs() > ROUGH, slope, 0.0)
