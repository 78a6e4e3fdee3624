"""A map as splats on a page, sent in blocks: new ones first, then the oldest, so that no update is long."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from edslam_ti.mapping.gaussians import GaussianMap

BLOCK = 16_384  # splats
MOST_BLOCKS = 8  # beyond, only every n-th Gaussian is shown, and drawn larger


@dataclass(frozen=True)
class Splats:
    """Gaussians as viewers draw them."""

    means: np.ndarray  # [N, 3] float32 metres
    quats: np.ndarray  # [N, 4] float32 wxyz
    scales: np.ndarray  # [N, 3] float32 metres
    opacities: np.ndarray  # [N] float32
    colors: np.ndarray  # [N, 3] float32 in [0, 1]

    def covariances(self) -> np.ndarray:  # [N, 3, 3]
        """Return the covariances R diag(s^2) R^T."""
        if len(self.means) == 0:
            return np.empty((0, 3, 3), np.float32)
        axes = Rotation.from_quat(self.quats, scalar_first=True).as_matrix().astype(np.float32)
        axes = axes * self.scales[:, None, :]
        return np.asarray(axes @ axes.transpose(0, 2, 1))

    def draw(self, scene: Any, name: str, **node: Any) -> Any:
        """Add them to viser's scene; return the handle."""
        rest = (self.covariances(), np.clip(self.colors, 0, 1), self.opacities[:, None])
        return scene.add_gaussian_splats(name, self.means, *rest, **node)


@dataclass(frozen=True)
class Block:
    """A part of the map, copied from it."""

    index: int
    splats: Splats


class SplatStream:
    """Which blocks of a growing and changing map a page gets next."""

    def __init__(self, scene: Any, name: str = "/map") -> None:
        self._scene = scene
        self._name = name
        self._shown: dict[int, Any] = {}  # handles by block
        self._sizes: dict[int, int] = {}  # splats of a block when it was copied
        self._next = 0
        self.num_blocks = 0  # of the map, when a block was last chosen

    def forget(self) -> None:
        """Send everything again."""
        self._sizes.clear()

    def copied(self, gaussians: GaussianMap) -> Block | None:
        """Copy the block that is due from the map; None: it is empty. Takes a few milliseconds."""
        count = len(gaussians)
        step = max(1, -(-count // (MOST_BLOCKS * BLOCK)))
        everyone = torch.arange(0, count, step)
        self.num_blocks = -(-len(everyone) // BLOCK)
        if self.num_blocks == 0:
            return None
        index = self._due([len(part) for part in everyone.split(BLOCK)])
        chosen = everyone[index * BLOCK : (index + 1) * BLOCK]
        self._sizes[index] = len(chosen)
        with torch.no_grad():
            part = gaussians.activated(chosen)
        size = np.float32(step**0.5)  # fewer splats cover the same surface
        return Block(
            index,
            Splats(
                part.means.detach().numpy(),
                part.quats.detach().numpy(),
                size * part.scales.detach().numpy(),
                part.opacities.detach().numpy(),
                np.repeat(part.colors.detach().numpy(), 3, axis=1),
            ),
        )

    def _due(self, sizes: list[int]) -> int:
        """Return the first block that has not been sent or has grown, else the one sent longest ago."""
        for k, size in enumerate(sizes):
            if self._sizes.get(k, 0) < size:
                return k
        self._next = (self._next + 1) % len(sizes)
        return self._next

    def send(self, block: Block) -> None:
        """Send a block to the pages, and take away those that the map has no more."""
        handle = self._shown.get(block.index)
        splats = block.splats
        if handle is None:
            self._shown[block.index] = splats.draw(self._scene, f"{self._name}/{block.index}")
        else:
            colors, opacities = np.clip(splats.colors, 0, 1), splats.opacities[:, None]
            handle.set_gaussians(splats.means, splats.covariances(), colors, opacities)
        for index in [k for k in self._shown if k >= max(self.num_blocks, 1)]:
            self._shown.pop(index).remove()
            self._sizes.pop(index, None)
