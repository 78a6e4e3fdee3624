"""The Gaussian map (Sec. III-C): parameters, activations, and an Adam optimiser that grows with it."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.optim.adam import adam

from edslam_ti.config import MappingConfig
from edslam_ti.geometry import quaternion_product

# Raw parameters and their widths; the names carry the parametrisation.
PARAMETERS = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacities": 0, "logit_colors": 1}

CELL_TABLE = 1 << 14  # entries a level; distant cells may share one, which only slows convergence
CELL_PRIMES = (73856093, 19349663, 83492791)  # Teschner et al. 2003, spatial hashing


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians as they are rendered."""

    means: Tensor  # [N, 3] metres, world
    quats: Tensor  # [N, 4] wxyz, any norm
    scales: Tensor  # [N, 3] metres
    opacities: Tensor  # [N] in (0, 1)
    colors: Tensor  # [N, 1] brightness in (0, 1)


class Moments(NamedTuple):
    """Adam's running means of a parameter's gradient and of its square."""

    first: Tensor
    second: Tensor

    @classmethod
    def zeros_like(cls, value: Tensor) -> Self:
        """Return the moments before the first step."""
        return cls(torch.zeros_like(value), torch.zeros_like(value))


class GaussianMap:
    """N Gaussians as raw (unbounded) parameters: means [N, 3] in metres (world), quats [N, 4] wxyz,
    log_scales [N, 3], logit_opacities [N], logit_colors [N, 1] (brightness in (0, 1) behind a sigmoid).

    A Gaussian's brightness logit is its own plus those of the cells it lies in, at several cell sizes.
    Events constrain brightness only across edges. If each Gaussian moved alone, a large surface would take
    thousands of steps to reach its level; with cells it moves as one.
    """

    def __init__(self, config: MappingConfig) -> None:
        empty = {name: torch.empty((0, width) if width else (0,)) for name, width in PARAMETERS.items()}
        self._rates = {
            "means": config.means_rate,
            "quats": config.quats_rate,
            "log_scales": config.scales_rate,
            "logit_opacities": config.opacities_rate,
            "logit_colors": config.colors_rate,
        }
        self._rate_factor = 1.0
        self._raw = {name: value.requires_grad_() for name, value in empty.items()}
        self._moments = {name: Moments.zeros_like(value) for name, value in empty.items()}
        self._steps = 0
        self._frames = torch.empty(0, dtype=torch.int64)  # [N] frame whose depth the Gaussian is from
        self._is_measured = torch.empty(0, dtype=torch.bool)  # [N] its depth was measured, not assumed
        self._cell_sizes = torch.tensor(config.brightness_cells)
        self._cells = torch.empty((0, len(self._cell_sizes)), dtype=torch.int64)  # [N, L] table entries
        self._cell_table = torch.zeros(len(self._cell_sizes) * CELL_TABLE, requires_grad=True)
        self._cell_moments = Moments.zeros_like(self._cell_table.detach())
        self._cell_steps = torch.tensor(0.0)
        self._cell_rate = config.cells_rate

    def __len__(self) -> int:
        return len(self._raw["means"])

    @property
    def raw(self) -> Mapping[str, Tensor]:
        """Raw parameters by name."""
        return self._raw

    def activated(self, chosen: Tensor | None = None) -> Gaussians:  # [M] indices; None: all
        """Return the parameters to render, differentiable in the raw ones; compute them once per step."""
        # index_select adds its gradients up in order; indexing does it in parallel, differently every run
        raw, cells = self._raw, self._cells
        if chosen is not None:
            raw = {name: value.index_select(0, chosen) for name, value in raw.items()}
            cells = cells.index_select(0, chosen)
        shared = self._cell_table.index_select(0, cells.reshape(-1)).view_as(cells)
        return Gaussians(
            raw["means"],
            raw["quats"],
            raw["log_scales"].exp(),
            raw["logit_opacities"].sigmoid(),
            (raw["logit_colors"] + shared.sum(-1, keepdim=True)).sigmoid(),
        )

    def subset(self, chosen: Tensor) -> "GaussianMap":  # [M] indices
        """Return the chosen Gaussians as a separate map, so that a step costs no more than they do.

        `update_from` copies the optimised values back. Both maps share the cells.
        """
        subset = copy.copy(self)
        subset._map_rows(lambda table: table.index_select(0, chosen))
        return subset

    def measured(self) -> "GaussianMap":
        """Return the Gaussians on measured surfaces, without those at assumed depth."""
        if bool(self._is_measured.all()):
            return self
        return self.subset(torch.nonzero(self._is_measured).squeeze(1))

    def update_from(self, subset: "GaussianMap", chosen: Tensor) -> None:  # [M] indices, as given to `subset`
        """Overwrite the chosen Gaussians and their moments with those of a subset."""
        for name, value in self._raw.items():
            value.detach().index_copy_(0, chosen, subset._raw[name].detach())
            for mine, theirs in zip(self._moments[name], subset._moments[name]):
                mine.index_copy_(0, chosen, theirs)
        self._steps = subset._steps

    def add(
        self,
        means: Tensor,  # [M, 3] metres
        quats: Tensor,  # [M, 4] wxyz
        scales: Tensor,  # [M, 3] metres
        opacity: float,
        colors: Tensor,  # [M, 1] in (0, 1)
        frame: int = 0,  # whose depth they are from
        is_measured: Tensor | None = None,  # [M] bool: depth was measured, not assumed; None: all
    ) -> None:
        """Append Gaussians; their optimiser moments start at zero."""
        m = len(means)
        is_measured = torch.ones(m, dtype=torch.bool) if is_measured is None else is_measured
        self._is_measured = torch.cat([self._is_measured, is_measured])
        self._frames = torch.cat([self._frames, torch.full((m,), frame)])
        cells = self._cells_of(means)
        shared = self._cell_table.detach()[cells].sum(-1, keepdim=True)
        self._cells = torch.cat([self._cells, cells])
        new = {
            "means": means,
            "quats": quats,
            "log_scales": scales.log(),
            "logit_opacities": torch.full((m,), opacity).logit(),
            "logit_colors": _logit(colors) - shared,
        }
        self._append(new)

    def clone(self, chosen: Tensor) -> Tensor:  # [M] indices -> [M] indices
        """Append copies of some Gaussians, moments at zero; return the copies' indices."""
        n = len(self)
        self._cells = torch.cat([self._cells, self._cells[chosen]])
        self._frames = torch.cat([self._frames, self._frames[chosen]])
        self._is_measured = torch.cat([self._is_measured, self._is_measured[chosen]])
        self._append({name: value.detach()[chosen] for name, value in self._raw.items()})
        return torch.arange(n, len(self))

    def overwrite(self, name: str, chosen: Tensor, values: Tensor) -> None:  # [M] indices, [M, ...]
        """Set a raw parameter of some Gaussians and reset its moments."""
        self._raw[name].detach()[chosen] = values.detach()
        for moment in self._moments[name]:
            moment[chosen] = 0

    def keep(self, mask: Tensor) -> None:
        """Keep the Gaussians where mask [N] is true."""
        self._map_rows(lambda table: table[mask])

    def remove_frames(self, frames: Sequence[int]) -> None:
        """Remove the Gaussians from the depth of some frames."""
        self.keep(~torch.isin(self._frames, torch.tensor(list(frames), dtype=torch.int64)))

    @torch.no_grad()
    def move_with_frames(self, corrections: Mapping[int, np.ndarray]) -> None:  # T_new T_old^-1 by frame
        """Move each Gaussian with the pose of the frame whose depth it is from."""
        frames = torch.tensor(sorted(corrections), dtype=torch.int64)
        chosen = torch.nonzero(torch.isin(self._frames, frames)).squeeze(1)
        if len(chosen) == 0:
            return
        of_frames = np.array([corrections[k] for k in frames.tolist()])  # [F, 4, 4]
        turns = Rotation.from_matrix(of_frames[:, :3, :3]).as_quat(scalar_first=True)
        at = torch.searchsorted(frames, self._frames[chosen])
        T, q = torch.from_numpy(of_frames).float()[at], torch.from_numpy(turns).float()[at]
        means = self._raw["means"][chosen]
        self._raw["means"][chosen] = (T[:, :3, :3] @ means[..., None])[..., 0] + T[:, :3, 3]
        self._raw["quats"][chosen] = quaternion_product(q, self._raw["quats"][chosen])

    def set_colors(self, colors: Tensor) -> None:  # [N, 1] in (0, 1)
        """Overwrite every Gaussian's brightness; the cells keep theirs."""
        with torch.no_grad():
            shared = self._cell_table[self._cells].sum(-1, keepdim=True)
            self._raw["logit_colors"].copy_(_logit(colors) - shared)

    def step(self) -> None:
        """Take one Adam step along the gradients, and clear them."""
        for name, value in self._raw.items():
            if value.grad is not None:
                steps = torch.tensor(float(self._steps))
                _move(value, self._moments[name], steps, self._rates[name] * self._rate_factor)
        if self._cell_table.grad is not None:
            rate = self._cell_rate * self._rate_factor
            _move(self._cell_table, self._cell_moments, self._cell_steps, rate)
        self._steps += 1

    def decay_rates(self, factor: float) -> None:
        """Set every learning rate to `factor` times its configured value."""
        self._rate_factor = factor

    def _cells_of(self, means: Tensor) -> Tensor:  # [M, 3] -> [M, L]
        """Return the entry of the brightness table that each mean shares at every cell size."""
        grid = torch.floor(means[:, None, :] / self._cell_sizes[:, None]).long()  # [M, L, 3]
        hashed = (grid * torch.tensor(CELL_PRIMES)).sum(-1) % CELL_TABLE
        return hashed + CELL_TABLE * torch.arange(len(self._cell_sizes))

    def _append(self, new: dict[str, Tensor]) -> None:
        """Append rows to every raw parameter; their moments start at zero."""
        for name, rows in new.items():
            self._raw[name] = torch.cat([self._raw[name].detach(), rows]).requires_grad_()
            self._moments[name] = Moments(
                *(torch.cat([moment, torch.zeros_like(rows)]) for moment in self._moments[name])
            )

    def _map_rows(self, change: Callable[[Tensor], Tensor]) -> None:
        """Replace every table that has one row per Gaussian."""
        self._cells, self._frames = change(self._cells), change(self._frames)
        self._is_measured = change(self._is_measured)
        self._raw = {name: change(value.detach()).requires_grad_() for name, value in self._raw.items()}
        self._moments = {name: Moments(*map(change, pair)) for name, pair in self._moments.items()}


def _logit(colors: Tensor) -> Tensor:
    """Return the logit of brightness, clamped where gradients would vanish."""
    return colors.clamp(0.002, 0.998).logit()


@torch.no_grad()
def _move(value: Tensor, moments: Moments, num_steps: Tensor, rate: float) -> None:
    """Take an Adam step along the gradient, clear it, and count the step.

    Making a `torch.optim.Adam` would import torch's compiler, which takes seconds.
    """
    assert value.grad is not None
    adam(
        [value], [value.grad], [moments.first], [moments.second], [], [num_steps],
        amsgrad=False, beta1=0.9, beta2=0.999, lr=rate, weight_decay=0.0, eps=1e-15, maximize=False,
        fused=True,  # one pass over the memory instead of eight
    )  # fmt: skip
    value.grad = None
