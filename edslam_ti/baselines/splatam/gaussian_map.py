"""The map: isotropic Gaussians as tensors on one device."""

import torch
from torch import Tensor

from edslam_ti.kernels.runtime import is_gpu
from edslam_ti.mapping.gaussians import Gaussians

# Raw parameters and their widths; a Gaussian's brightness is not bounded while it is optimised.
PARAMETERS = {"means": 3, "log_scales": 1, "logit_opacities": 0, "colors": 1}


class IsotropicMap:
    """N Gaussians: means [N, 3] metres (world), log_scales [N, 1], logit_opacities [N], colors [N, 1].

    Between frames the parameters need no gradients. A frame's optimisation takes a copy of those in view
    (`leaves`) and writes it back (`overwrite`).
    """

    def __init__(self) -> None:
        self.device = "cuda" if is_gpu() else "cpu"
        self._raw = {
            name: torch.empty((0, width) if width else (0,), device=self.device)
            for name, width in PARAMETERS.items()
        }

    def __len__(self) -> int:
        return len(self._raw["means"])

    @property
    def raw(self) -> dict[str, Tensor]:
        """Raw parameters by name."""
        return self._raw

    def activated(self, chosen: Tensor | None = None) -> Gaussians:  # [M] indices; None: all
        """Return the parameters to render."""
        raw = self._raw
        if chosen is not None:
            raw = {name: value.index_select(0, chosen) for name, value in raw.items()}
        return activated(raw)

    def leaves(self, chosen: Tensor) -> dict[str, Tensor]:  # [M] indices
        """Return copies of some Gaussians' parameters, to be optimised."""
        return {name: value.index_select(0, chosen).requires_grad_() for name, value in self._raw.items()}

    def overwrite(self, chosen: Tensor, leaves: dict[str, Tensor]) -> None:  # [M] indices
        """Write optimised parameters back."""
        for name, value in leaves.items():
            self._raw[name].index_copy_(0, chosen, value.detach())

    def add(
        self,
        means: Tensor,  # [M, 3] metres, world
        scales: Tensor,  # [M] metres
        opacity: float,
        colors: Tensor,  # [M] brightness
    ) -> None:
        """Append Gaussians."""
        new = {
            "means": means,
            "log_scales": scales.log()[:, None],
            "logit_opacities": torch.full_like(scales, opacity).logit(),
            "colors": colors[:, None],
        }
        self._raw = {name: torch.cat([value, new[name]]) for name, value in self._raw.items()}

    def keep(self, mask: Tensor) -> None:  # [N] bool
        """Keep the Gaussians where the mask is true."""
        self._raw = {name: value[mask] for name, value in self._raw.items()}


def activated(raw: dict[str, Tensor]) -> Gaussians:
    """Return raw parameters as they are rendered, differentiable in them."""
    scales = raw["log_scales"].exp().expand(-1, 3)
    return Gaussians(
        raw["means"],
        no_rotation(scales),
        scales,
        raw["logit_opacities"].sigmoid(),
        raw["colors"],
    )


def no_rotation(scales: Tensor) -> Tensor:  # [N, 3] -> [N, 4] wxyz
    """Return quaternions of spheres, whose orientation has no effect."""
    return scales.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(scales), 4)
