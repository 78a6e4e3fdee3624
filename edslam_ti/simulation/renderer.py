"""Renders grey image and exact depth of a scene from any pose by ray casting.

One ray per pixel centre gives depth and, through a filtered texture look-up, brightness. Pixels next to
another surface are rendered again with several rays (anti-aliasing at edges).
"""

from dataclasses import dataclass

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.kernels.texture import mark_edges, pixel_rays, shade, write_sample_means
from edslam_ti.lenses import Lens
from edslam_ti.ray_casting import Hits, RayCaster
from edslam_ti.simulation.scene import Scene

EDGE_CONTRAST = 0.02  # edges with at least this Michelson contrast between their surfaces are anti-aliased


@dataclass(frozen=True)
class Render:
    """A camera's view from one pose."""

    grey: np.ndarray  # [H, W] float32 in [0, 1]
    depth: np.ndarray  # [H, W] float32 metres along the optical axis at pixel centres, 0: nothing hit
    _directions: np.ndarray  # [H W, 3] of the viewing rays
    _normals: np.ndarray  # [H W, 3] unit normals of what they hit

    @property
    def cosine(self) -> np.ndarray:  # [H, W] float32
        """Cosine of the angle between viewing ray and surface normal, not negative."""
        along = np.abs((self._directions * self._normals).sum(1))
        return (along / np.linalg.norm(self._directions, axis=1)).reshape(self.depth.shape)

    def covered_by(self, other: "Render", T_world_other: np.ndarray) -> "Render":
        """Return the view with another one's surfaces (in a frame of their own) where they are nearer."""
        is_nearer = (other.depth > 0) & ((other.depth < self.depth) | (self.depth == 0))
        chosen = is_nearer.ravel()[:, None]
        return Render(
            np.where(is_nearer, other.grey, self.grey),
            np.where(is_nearer, other.depth, self.depth),
            self._directions,
            np.where(chosen, other._normals @ T_world_other[:3, :3].T, self._normals).astype(np.float32),
        )


class Renderer:
    """Ray caster of one scene and one camera."""

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        samples_per_edge_pixel: int = 6,
        background: float = 0.5,
        lens: Lens | None = None,  # of this camera; None: a pinhole
    ) -> None:
        self.camera = camera
        self._through_lens = None if lens is None else _LensRays(lens)
        self.background = background
        self._caster = RayCaster(scene.vertices, scene.triangles)
        self._triangles = scene.triangle_table()
        self._textures = scene.texture_table()
        self._pixels = np.arange(camera.width * camera.height, dtype=np.int32)
        self._centre = np.zeros((1, 2), np.float32)
        self._offsets = _sample_offsets(samples_per_edge_pixel)

    def render(self, T_world_camera: np.ndarray) -> Render:  # [4, 4]
        """Return image and depth from a pose; pixel centres at integer coordinates."""
        shape = self.camera.shape
        rays, hits, grey, surface = self._cast(T_world_camera, self._pixels, self._centre, 1.0)
        edges = mark_edges(grey.reshape(shape), surface.reshape(shape), EDGE_CONTRAST)
        refine = np.flatnonzero(edges).astype(np.int32)
        if len(refine) and len(self._offsets) > 1:
            scale = 1.0 / np.sqrt(len(self._offsets))
            _, _, samples, _ = self._cast(T_world_camera, refine, self._offsets, scale)
            write_sample_means(samples.reshape(len(refine), -1), refine, grey)
        return Render(grey.reshape(shape), hits.depth.reshape(shape), rays[:, 3:], hits.normal)

    def _cast(
        self, T_world_camera: np.ndarray, pixels: np.ndarray, offsets: np.ndarray, scale: float
    ) -> tuple[np.ndarray, Hits, np.ndarray, np.ndarray]:
        """Return rays, hits, grey and surface of len(pixels) * len(offsets) rays."""
        if self._through_lens is not None:
            rays = self._through_lens(T_world_camera, pixels, offsets)
        else:
            rays = pixel_rays(T_world_camera, self.camera.intrinsics, self.camera.width, pixels, offsets)
        return self._shaded(T_world_camera, rays, scale)

    def _shaded(
        self, T_world_camera: np.ndarray, rays: np.ndarray, scale: float
    ) -> tuple[np.ndarray, Hits, np.ndarray, np.ndarray]:
        """Return rays [N, 6], whose directions have camera z = 1, with hits, grey and surface."""
        hits = self._caster.cast(rays)
        R = T_world_camera[:3, :3]
        steps = np.stack([R[:, 0] / self.camera.fx, R[:, 1] / self.camera.fy]) * scale
        grey, surface = shade(
            rays,
            hits.distance,
            hits.triangle,
            hits.uv,
            steps,
            self._triangles,
            self._textures,
            self.background,
        )
        return rays, hits, grey, surface


class _LensRays:
    """The viewing rays of a camera whose lens distorts."""

    def __init__(self, lens: Lens) -> None:
        rays = np.nan_to_num(lens.rays.astype(np.float64))  # [H, W, 2]; nothing is seen where there is none
        self._rays = rays.reshape(-1, 2)
        self._along = [np.gradient(rays, axis=axis).reshape(-1, 2) for axis in (1, 0)]  # per pixel in x, y

    def __call__(
        self,
        T_world_camera: np.ndarray,  # [4, 4]
        pixels: np.ndarray,  # [M] flat indices
        offsets: np.ndarray,  # [S, 2] (x, y) from the pixel centre
    ) -> np.ndarray:  # [M * S, 6] float32: origin, direction with camera z = 1
        """Return rays; between pixel centres they are straight lines in x and y."""
        x, y = offsets[None, :, :1], offsets[None, :, 1:]
        at = self._rays[pixels, None] + x * self._along[0][pixels, None] + y * self._along[1][pixels, None]
        at = at.reshape(-1, 2)
        R, origin = T_world_camera[:3, :3], T_world_camera[:3, 3]
        rays = np.empty((len(at), 6), np.float32)
        rays[:, :3] = origin
        rays[:, 3:] = at @ R[:, :2].T + R[:, 2]
        return rays


def _sample_offsets(count: int) -> np.ndarray:  # [S, 2] float32
    """Return sub-pixel positions, one in each of `count` rows and columns (n-rooks)."""
    steps = {1: 1, 2: 1, 3: 1, 4: 2, 5: 2, 6: 5, 7: 3, 8: 3, 9: 4}.get(count, 5)
    while np.gcd(steps, count) != 1:
        steps += 1
    k = np.arange(count)
    return (np.stack([k + 0.5, (k * steps) % count + 0.5], 1) / count - 0.5).astype(np.float32)
