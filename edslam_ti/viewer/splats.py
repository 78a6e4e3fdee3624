"""A map as splats on a page, sent in blocks: new ones first, then the oldest, so that no update is long."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from edslam_ti.camera import Camera
from edslam_ti.mapping.gaussians import GaussianMap

BLOCK = 16_384  # splats
MOST_BLOCKS = 16  # beyond, only some of the Gaussians are shown, and drawn larger
MOST_EYES = 8  # of the path, from which distances are measured
PIXEL_SIGMA = 0.3**0.5  # pixels (Kerbl et al. 2023), as kernels/projection.py has it
SCATTERED = 2654435761  # times an index, modulo 2^32: any part of the range holds the same share (Knuth)


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

    def widened(self, sigmas: np.ndarray) -> "Splats":  # [N] metres
        """Return them blurred by isotropic Gaussians."""
        scales = np.sqrt(self.scales**2 + sigmas.astype(np.float32)[:, None] ** 2)
        return Splats(self.means, self.quats, scales, self.opacities, self.colors)

    def draw(self, scene: Any, name: str, **node: Any) -> Any:
        """Add them to viser's scene; return the handle."""
        return scene.add_gaussian_splats(name, *self._arrays(), **node)

    def send(self, handle: Any) -> None:
        """Replace what a handle shows."""
        handle.set_gaussians(*self._arrays())

    def _arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return self.means, self.covariances(), np.clip(self.colors, 0, 1), self.opacities[:, None]

    def padded(self, count: int) -> "Splats":
        """Return `count` splats: these, then some that cannot be seen."""
        missing = count - len(self.means)
        if missing <= 0:
            return self
        point = self.means[:1] if len(self.means) else np.zeros((1, 3), np.float32)
        return Splats(
            np.concatenate([self.means, np.repeat(point, missing, axis=0)]),
            np.concatenate([self.quats, np.tile(np.array([1, 0, 0, 0], np.float32), (missing, 1))]),
            np.concatenate([self.scales, np.full((missing, 3), 1e-4, np.float32)]),
            np.concatenate([self.opacities, np.zeros(missing, np.float32)]),
            np.concatenate([self.colors, np.zeros((missing, 3), np.float32)]),
        )


_EMPTY = np.empty((0, 3), np.float32)
NOTHING = Splats(_EMPTY, np.empty((0, 4), np.float32), _EMPTY, np.empty(0, np.float32), _EMPTY)


@dataclass(frozen=True)
class Block:
    """A part of the map, copied from it."""

    index: int
    num_blocks: int  # of the map
    splats: Splats


def splats_of(gaussians: GaussianMap, chosen: torch.Tensor, size: float = 1.0) -> Splats:  # [M] indices
    """Copy Gaussians from a map, `size` times as large."""
    with torch.no_grad():
        part = gaussians.activated(chosen)
    return Splats(
        part.means.detach().numpy(),
        part.quats.detach().numpy(),
        np.float32(size) * part.scales.detach().numpy(),
        part.opacities.detach().numpy(),
        np.repeat(part.colors.detach().numpy(), 3, axis=1),
    )


def pixel_sigmas(
    means: np.ndarray,  # [N, 3] metres, world
    poses: np.ndarray,  # [F, 4, 4] T_world_camera
    camera: Camera,
) -> np.ndarray:  # [N] metres
    """Return how wide the blur of the recording's pixels is at each splat, seen from the nearest camera.

    Maps are made for images in which every splat is blurred by that much. A page has smaller pixels, and
    would show holes between the splats.
    """
    eyes = poses[np.unique(np.linspace(0, len(poses) - 1, MOST_EYES).round().astype(int)), :3, 3]
    distances = [np.linalg.norm(means - eye.astype(np.float32), axis=1) for eye in eyes]
    return np.asarray(PIXEL_SIGMA / camera.fx * np.min(distances, axis=0))


class SplatStream:
    """Which blocks of a growing and changing map a page gets next.

    A page sorts all splats again whenever their number changes, and shows none until it has. So blocks are
    padded with splats that cannot be seen, and their number is a power of two.
    """

    def __init__(self, scene: Any, name: str = "/map") -> None:
        self._scene = scene
        self._name = name
        self._shown: list[Any] = []  # handles
        self._sizes: dict[int, int] = {}  # splats of a block when it was copied
        self._next = 0
        self.num_blocks = 0  # of the map, when a block was last chosen

    def copied(self, gaussians: GaussianMap) -> Block | None:
        """Copy the block that is due from the map; None: it is empty. Takes a few milliseconds."""
        step = max(1.0, len(gaussians) / (MOST_BLOCKS * BLOCK))
        everyone = torch.arange(len(gaussians))
        if step > 1:
            everyone = everyone[everyone * SCATTERED % 2**32 < 2**32 / step][: MOST_BLOCKS * BLOCK]
        self.num_blocks = -(-len(everyone) // BLOCK)
        if self.num_blocks == 0:
            return None
        index = self._due([len(part) for part in everyone.split(BLOCK)])
        chosen = everyone[index * BLOCK : (index + 1) * BLOCK]
        self._sizes[index] = len(chosen)
        size = step**0.5  # fewer splats cover the same surface
        return Block(index, self.num_blocks, splats_of(gaussians, chosen, size).padded(BLOCK))

    def _due(self, sizes: list[int]) -> int:
        """Return the first block that has not been sent or has changed its size, else the oldest."""
        for k, size in enumerate(sizes):
            if self._sizes.get(k, 0) != size:
                return k
        self._next = (self._next + 1) % len(sizes)
        return self._next

    def send(self, block: Block, poses: np.ndarray, camera: Camera) -> None:
        """Send a block to the pages; the path and its camera say from how near it was seen."""
        needed = 1 << (block.num_blocks - 1).bit_length()
        while len(self._shown) < needed:
            name = f"{self._name}/{len(self._shown)}"
            self._shown.append(NOTHING.padded(BLOCK).draw(self._scene, name))
        for k, handle in enumerate(self._shown):
            handle.visible = k < block.num_blocks
        sigmas = pixel_sigmas(block.splats.means, poses, camera)
        block.splats.widened(sigmas).send(self._shown[block.index])
