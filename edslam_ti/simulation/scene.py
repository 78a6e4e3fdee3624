"""A textured triangle scene for the renderer, and a builder that collects its parts.

World of the built-in rooms: metres, z up, floor at z = 0. Meshes keep the axes of their file.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.kernels.texture import TextureTable, TriangleTable

TEXEL = 0.004  # metres per texel of tiled textures
NO_LIGHT = -1


@dataclass(frozen=True)
class Texture:
    """A grey image, and whether it repeats beyond its borders."""

    image: np.ndarray  # [H, W] float32 in [0, 1]
    repeat: bool


@dataclass(frozen=True)
class Scene:
    """Triangles with texture coordinates in texels (x right, y down, texel i covers [i, i+1))."""

    vertices: np.ndarray  # [V, 3] float32 metres
    triangles: np.ndarray  # [T, 3] uint32
    texture_coordinates: np.ndarray  # [T, 3, 2] float32 texels
    texture_ids: np.ndarray  # [T] int32, -1: none
    tints: np.ndarray  # [T, 3] float32, factor at each corner
    light_coordinates: np.ndarray  # [T, 3, 2] float32 texels of the light map
    light_ids: np.ndarray  # [T] int32, -1: unlit (self-luminous, or light baked into the texture)
    surfaces: np.ndarray  # [T] int32, triangles of one flat piece share a number
    textures: list[Texture]
    description: str

    def triangle_table(self) -> TriangleTable:
        """Return the data of each triangle for the shading kernel."""
        corners = self.vertices[self.triangles].astype(np.float64)  # [T, 3, 3]
        e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        normal = np.cross(e1, e2)
        area = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = np.divide(normal, area, out=np.zeros_like(normal), where=area > 0)
        # Gradient of an affine function with differences d1, d2 along e1, e2:
        # (d1 (e2 x n) + d2 (n x e1)) / |e1 x e2|.
        dual_1 = np.divide(np.cross(e2, normal), area, out=np.zeros_like(normal), where=area > 0)
        dual_2 = np.divide(np.cross(normal, e1), area, out=np.zeros_like(normal), where=area > 0)
        uv = self.texture_coordinates.astype(np.float64)
        d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]  # [T, 2]
        gradient = d1[:, :, None] * dual_1[:, None] + d2[:, :, None] * dual_2[:, None]  # [T, 2, 3]
        count = len(self.triangles)
        values = np.concatenate(
            [
                uv.reshape(count, 6),
                gradient.reshape(count, 6),
                normal,
                self.tints,
                self.light_coordinates.reshape(count, 6),
            ],
            axis=1,
        )
        indices = np.stack([self.texture_ids, self.light_ids, self.surfaces], 1)
        return TriangleTable(
            np.ascontiguousarray(values, np.float32), np.ascontiguousarray(indices, np.int32)
        )

    def texture_table(self) -> TextureTable:
        """Return all textures with their mip levels (each the 2x2 mean of the one before)."""
        import cv2

        pieces: list[np.ndarray] = []
        rows: list[list[tuple[int, int, int]]] = []
        offset = 0
        for texture in self.textures:
            image: np.ndarray = np.ascontiguousarray(texture.image, np.float32)
            levels = []
            while True:
                height, width = image.shape
                levels.append((offset, width, height))
                pieces.append(image.ravel())
                offset += image.size
                if min(width, height) <= 1:
                    break
                image = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
                image = image.reshape(height // 2, width // 2)
            rows.append(levels)
        deepest = max((len(levels) for levels in rows), default=1)
        table = np.zeros((max(len(rows), 1), deepest, 3), np.int32)
        for k, levels in enumerate(rows):
            table[k, : len(levels)] = levels
            table[k, len(levels) :] = levels[-1]
        return TextureTable(
            texels=np.concatenate(pieces) if pieces else np.zeros(1, np.float32),
            levels=table,
            num_levels=np.array([len(levels) for levels in rows] or [1], np.int32),
            repeat=np.array([texture.repeat for texture in self.textures] or [False], np.int32),
        )

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest corner [3] in metres."""
        return self.vertices.min(0), self.vertices.max(0)


@dataclass(frozen=True)
class Material:
    """A texture with its size on the surface and its brightness."""

    texture: int  # index into the builder's textures
    texel: float | None = TEXEL  # metres per texel; None: stretched over the whole face
    tint: float = 1.0
    turned: bool = False  # grain along the other side of the face
    luminous: bool = False  # drawn without shading


@dataclass
class Quad:
    """A parallelogram o + a u + b v with a, b in [0, 1]; seen from the side of u x v."""

    origin: np.ndarray  # [3]
    u: np.ndarray  # [3] to the right
    v: np.ndarray  # [3] down
    material: Material
    offset: np.ndarray  # [2] texels
    span: tuple[float, float] = (0.0, 1.0)  # share of a stretched texture's width that is shown

    @property
    def normal(self) -> np.ndarray:  # [3], towards the viewer
        n = np.cross(self.v, self.u)
        return n / np.linalg.norm(n)


@dataclass
class SceneBuilder:
    """Collects quads in nested local frames (x right, y away from the viewer, z up)."""

    seed: int
    quads: list[Quad] = field(default_factory=list)
    textures: list[Texture] = field(default_factory=list)
    rng: np.random.Generator = field(init=False)
    _frame: np.ndarray = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def texture(self, image: np.ndarray, repeat: bool = True) -> int:
        """Add a texture and return its index."""
        if image.ndim != 2 or image.dtype != np.float32:
            raise DataError(f"texture: expected a [H, W] float32 image, got {image.dtype} {image.shape}")
        self.textures.append(Texture(np.clip(image, 0.02, 0.98), repeat))
        return len(self.textures) - 1

    @contextmanager
    def placed(
        self, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0, pitch: float = 0.0
    ) -> Iterator[None]:
        """Place all that the block adds at a position (metres), turned about z, then about x (degrees)."""
        a, b = np.radians(yaw), np.radians(pitch)
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        tip = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
        local = np.eye(4)
        local[:3, :3] = turn @ tip
        local[:3, 3] = x, y, z
        outer = self._frame
        self._frame = outer @ local
        try:
            yield
        finally:
            self._frame = outer

    def quad(
        self,
        origin: tuple[float, float, float],
        u: tuple[float, float, float],
        v: tuple[float, float, float],
        material: Material,
        span: tuple[float, float] = (0.0, 1.0),
    ) -> None:
        """Add a parallelogram: `origin` its top left corner, `u` to the right, `v` down (metres)."""
        R, t = self._frame[:3, :3], self._frame[:3, 3]
        offset = self.rng.integers(0, 4096, 2).astype(np.float64)
        self.quads.append(
            Quad(R @ np.array(origin) + t, R @ np.array(u), R @ np.array(v), material, offset, span)
        )

    def box(
        self,
        low: tuple[float, float, float],
        high: tuple[float, float, float],
        material: Material,
        **faces: Material | None,
    ) -> None:
        """Add a box; `front` (-y), `back`, `left` (-x), `right`, `top`, `bottom` override (None: omitted)."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
        for name, origin, u, v in (
            ("front", (x0, y0, z1), (dx, 0, 0), (0, 0, -dz)),
            ("back", (x1, y1, z1), (-dx, 0, 0), (0, 0, -dz)),
            ("left", (x0, y1, z1), (0, -dy, 0), (0, 0, -dz)),
            ("right", (x1, y0, z1), (0, dy, 0), (0, 0, -dz)),
            ("top", (x0, y1, z1), (dx, 0, 0), (0, -dy, 0)),
            ("bottom", (x0, y0, z0), (dx, 0, 0), (0, dy, 0)),
        ):
            face = faces.get(name, material)
            if face is not None:
                self.quad(origin, u, v, face)

    def cylinder(
        self,
        x: float,
        y: float,
        z0: float,
        z1: float,
        radius: float,
        material: Material,
        top: Material | None = None,
        sides: int = 14,
        top_radius: float | None = None,
    ) -> None:
        """Add an upright cylinder (or frustum) with its top; metres. A label is stretched once around."""
        upper = radius if top_radius is None else top_radius
        angles = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.stack([np.cos(angles), np.sin(angles)], 1)
        for k in range(sides):
            a, b = ring[k], ring[k + 1]
            middle = (upper + radius) / 2
            # A frustum's trapezoids are replaced by parallelograms of the mean width; the tilt is kept.
            centre = (a + b) / 2
            half = (b - a) / 2 * middle
            shift_top, shift_low = centre * upper, centre * radius
            origin = (x + shift_top[0] - half[0], y + shift_top[1] - half[1], z1)
            down = (shift_low[0] - shift_top[0], shift_low[1] - shift_top[1], z0 - z1)
            self.quad(origin, (2 * half[0], 2 * half[1], 0.0), down, material, (k / sides, (k + 1) / sides))
        cap = top or material
        for k in range(0, sides, 2):  # a fan of parallelograms covers a regular polygon of even sides
            a, b = ring[k] * upper, ring[k + 1] * upper
            c = ring[(k + 2) % sides] * upper
            self._triangle((x, y, z1), (x + a[0], y + a[1], z1), (x + b[0], y + b[1], z1), cap)
            self._triangle((x, y, z1), (x + b[0], y + b[1], z1), (x + c[0], y + c[1], z1), cap)

    def _triangle(
        self,
        a: tuple[float, float, float],
        b: tuple[float, float, float],
        c: tuple[float, float, float],
        material: Material,
    ) -> None:
        """Add one triangle as a degenerate piece: half of the parallelogram a, b, c."""
        R, t = self._frame[:3, :3], self._frame[:3, 3]
        A, B, C = (R @ np.array(p) + t for p in (a, b, c))
        self.quads.append(HalfQuad(A, C - A, B - A, material, np.zeros(2)))

    def build(self, description: str, light: "LightMaps | None" = None) -> Scene:
        """Return the scene; `light` holds one light map per quad."""
        count = len(self.quads)
        origin = np.array([q.origin for q in self.quads])
        u = np.array([q.u for q in self.quads])
        v = np.array([q.v for q in self.quads])
        corners = np.stack([origin, origin + v, origin + u + v, origin + u], 1)  # [Q, 4, 3]
        unit = np.array([[0, 0], [0, 1], [1, 1], [1, 0]], np.float64)  # (a, b) of the corners
        uv = np.empty((count, 4, 2))
        for k, q in enumerate(self.quads):
            height, width = self.textures[q.material.texture].image.shape
            if q.material.texel is None:
                size = np.array([width, height], np.float64)
                stretched = unit * (q.span[1] - q.span[0], 1.0) + (q.span[0], 0.0)
                uv[k] = stretched * size
            else:
                lengths = np.array([np.linalg.norm(q.u), np.linalg.norm(q.v)]) / q.material.texel
                uv[k] = unit * lengths
                if q.material.turned:
                    uv[k] = uv[k][:, ::-1]
                uv[k] += q.offset % (width, height)
        textures = list(self.textures)
        light_ids = np.full(count, NO_LIGHT, np.int32)
        light_uv = np.zeros((count, 4, 2))
        if light is not None:
            for k, q in enumerate(self.quads):
                if not q.material.luminous:
                    image = light.images[k]
                    light_ids[k] = len(textures)
                    light_uv[k] = unit * (image.shape[1], image.shape[0])
                    textures.append(Texture(image, repeat=False))
        first = np.array([[0, 1, 2], [0, 2, 3]])
        half = np.array([isinstance(q, HalfQuad) for q in self.quads])
        keep = np.stack([~half, ~half], 1)  # a half is the triangle (origin, origin + v, origin + u)
        selection = np.tile(first, (count, 1, 1))  # [Q, 2, 3]
        selection[half, 0] = (0, 1, 3)
        keep[half, 0] = True
        quad_index = np.repeat(np.arange(count), 2)[keep.ravel()]
        local = selection.reshape(-1, 3)[keep.ravel()]  # [T, 3]
        tints = np.array([q.material.tint for q in self.quads])[quad_index]
        return Scene(
            vertices=corners.reshape(-1, 3).astype(np.float32),
            triangles=(4 * quad_index[:, None] + local).astype(np.uint32),
            texture_coordinates=uv[quad_index[:, None], local].astype(np.float32),
            texture_ids=np.array([q.material.texture for q in self.quads], np.int32)[quad_index],
            tints=np.repeat(tints[:, None], 3, 1).astype(np.float32),
            light_coordinates=light_uv[quad_index[:, None], local].astype(np.float32),
            light_ids=light_ids[quad_index],
            surfaces=quad_index.astype(np.int32),
            textures=textures,
            description=description,
        )


class HalfQuad(Quad):
    """The triangle o, o + v, o + u of a parallelogram."""


@dataclass(frozen=True)
class LightMaps:
    """One small light map per quad."""

    images: list[np.ndarray]  # [h, w] float32 factors
