"""The brightness of all Gaussians at once, from the event loss between many pairs of renders.

Events fix brightness across edges only. The level of a wide surface follows from many weak differences, which
gradient steps on one pair after another find in tens of thousands of steps. For fixed geometry the problem is
nearly linear: a pixel shows one Gaussian above all, the one at half the opacity. So a pair of views a and b
says of the corrections x of log brightness

    x[seen at b] - x[seen at a] = measured change - rendered change        Eq. 10 to 12, one row per pixel

Conjugate gradients solve for x with Huber's weights; the result is a Gauss-Newton step of the event loss.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.rendering import RenderOutput

HUBER = 0.3  # log brightness; larger residuals count linearly: they are of edges that are misplaced
HOLD = 0.05  # rows' worth of a weak pull to no correction, which fixes what no pair determines
STRIDE = 2  # every second pixel in either direction
VOXELS = (0.1, 0.4)  # metres; Gaussians that no view shows get the mean correction around them
WHITE_SHARE = 0.99  # this share of the pixels is darker than the white level


@dataclass(frozen=True)
class Pair:
    """The change measured between two views."""

    start: int  # index of a view
    end: int
    change: Tensor  # [H, W] log brightness


@torch.no_grad()
def solve_brightness(
    gaussians: GaussianMap,  # of N
    views: Sequence[RenderOutput],
    pairs: Sequence[Pair],
    epsilon: float,
    white_level: float,  # brightness that the brightest percent of pixels gets: events do not say
    iterations: int,
) -> bool:
    """Correct the Gaussians' brightness; return whether there was anything to correct by."""
    seen = [view.dominant[::STRIDE, ::STRIDE].reshape(-1).long() for view in views]
    logs = [(view.intensity[::STRIDE, ::STRIDE].reshape(-1) + epsilon).log() for view in views]
    rows = [_rows(pair, seen, logs) for pair in pairs]
    if not rows:
        return False
    first, second, residual = (torch.cat(parts) for parts in zip(*rows))
    if len(residual) == 0:
        return False
    weight = (HUBER / residual.abs().clamp_min(1e-6)).clamp_max(1.0)
    factors = -torch.ones_like(residual), torch.ones_like(residual)
    correction, is_seen = conjugate_gradients(
        first, second, factors, weight, residual, len(gaussians), HOLD, iterations
    )
    correction = _spread(gaussians.raw["means"].detach(), correction, is_seen)
    shown = [log[k >= 0] + correction[k[k >= 0]] for log, k in zip(logs, seen)]
    white = torch.cat(shown).sort().values
    correction += torch.log(torch.tensor(white_level + epsilon)) - white[int(WHITE_SHARE * (len(white) - 1))]
    brightness = gaussians.activated().colors[:, 0]
    gaussians.set_colors(((brightness + epsilon) * correction.exp() - epsilon)[:, None])
    return True


def _rows(pair: Pair, seen: list[Tensor], logs: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Gaussians seen at the start and at the end, and the residual, where both are seen."""
    a, b = seen[pair.start], seen[pair.end]
    residual = pair.change[::STRIDE, ::STRIDE].reshape(-1) - (logs[pair.end] - logs[pair.start])
    used = (a >= 0) & (b >= 0) & (a != b)
    return a[used], b[used], residual[used]


def conjugate_gradients(
    first: Tensor,  # [R] unknown
    second: Tensor,  # [R] unknown
    factors: tuple[Tensor, Tensor],  # [R] each, of the two
    weight: Tensor,  # [R]
    residual: Tensor,  # [R]
    count: int,
    hold: float,
    iterations: int,
) -> tuple[Tensor, Tensor]:  # [N] unknowns, [N] bool: some row holds it
    """Minimise sum w (f_2 x[second] + f_1 x[first] - residual)^2 + hold |x|^2."""
    of_first, of_second = factors

    def gathered(value: Tensor) -> Tensor:  # [R] -> [N]: the transpose of the rows
        zero = torch.zeros(count, dtype=value.dtype, device=value.device)
        return zero.index_add_(0, second, of_second * value).index_add_(0, first, of_first * value)

    def applied(x: Tensor) -> Tensor:
        rows = of_second * x.index_select(0, second) + of_first * x.index_select(0, first)
        return gathered(weight * rows) + hold * x

    diagonal = torch.full((count,), hold, device=residual.device)
    diagonal = diagonal.index_add_(0, second, weight * of_second**2)
    diagonal = diagonal.index_add_(0, first, weight * of_first**2)
    x = torch.zeros_like(diagonal)
    r = gathered(weight * residual)
    z = r / diagonal
    p, rz = z, r @ z
    for _ in range(iterations):
        q = applied(p)
        step = rz / (p @ q).clamp_min(1e-30)
        x, r = x + step * p, r - step * q
        z = r / diagonal
        last, rz = rz, r @ z
        p = z + rz / last.clamp_min(1e-30) * p
    return x, diagonal > 2 * hold


def _spread(means: Tensor, correction: Tensor, is_seen: Tensor) -> Tensor:  # [N, 3], [N], [N] -> [N]
    """Give Gaussians that no row holds the mean of those in their voxel, else of all."""
    result = torch.where(is_seen, correction, correction[is_seen].mean())
    for size in reversed(VOXELS):
        voxels = torch.floor(means / size).long()
        _, voxel = torch.unique(voxels, dim=0, return_inverse=True)
        number = int(voxel.max()) + 1
        zero = torch.zeros(number, device=means.device)
        total = zero.clone().index_add_(0, voxel[is_seen], correction[is_seen])
        held = zero.index_add_(0, voxel[is_seen], torch.ones_like(correction[is_seen]))
        has_mean = ~is_seen & (held[voxel] > 0)
        result = torch.where(has_mean, (total / held.clamp_min(1))[voxel], result)
    return result
