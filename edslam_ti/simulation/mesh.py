"""Loads textured or vertex-coloured meshes (obj, ply, glb, ...) as scenes with Open3D.

Brightness is the file's colour (base colour x texture x vertex colour) without shading, because colours of
scanned meshes such as Replica's contain the light. Axes are the file's (glTF: y up; many scans: z up).
"""

from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.mesh_reading import MeshPart, read_model
from edslam_ti.simulation.mesh_textures import check_glb_textures, check_obj_textures
from edslam_ti.simulation.scene import NO_LIGHT, Scene, Texture

LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601, as OpenCV converts colour to grey
READER_DEFAULT = 0.6  # base colour that Open3D's obj reader (Assimp) reports where a material has no Kd
SMALLEST, LARGEST = 1e-3, 1e6  # metres
SUFFIXES = (".obj", ".ply", ".glb", ".gltf", ".off", ".stl")


def load_mesh(path: Path, scale: float = 1.0) -> Scene:
    """Return a mesh file as a scene, its vertices multiplied by `scale` (to metres)."""
    if not path.is_file():
        raise FileNotFoundError(f"mesh {path} not found")
    if path.suffix.lower() not in SUFFIXES:
        raise DataError(f"{path}: expected a mesh file ({', '.join(SUFFIXES)}), got '{path.suffix}'")
    if not (np.isfinite(scale) and scale > 0):
        raise DataError(f"mesh scale: expected a positive factor, got {scale:g}")
    if path.suffix.lower() == ".obj":
        check_obj_textures(path)
    elif path.suffix.lower() in (".glb", ".gltf"):
        check_glb_textures(path)
    parts = [_Part(path, part) for part in read_model(path)]
    if not any(part.coloured for part in parts):
        raise DataError(
            f"{path}: expected a texture or vertex colours, found neither; "
            "export the mesh with its texture image (obj + mtl + png, glb) or with vertex colours (ply)"
        )
    vertices = np.concatenate([part.vertices for part in parts]) * scale
    extent = float(np.ptp(vertices, axis=0).max())
    if not SMALLEST <= extent <= LARGEST or np.abs(vertices).max() > LARGEST:
        raise DataError(
            f"{path}: expected a scene of {SMALLEST:g} to {LARGEST:g} m, not {extent:g} m that reaches "
            f"to {np.abs(vertices).max():g} m; check its scale"
        )
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])
    textures: list[Texture] = []
    texture_ids = []
    for part in parts:
        texture_ids.append(
            np.full(len(part.triangles), len(textures) if part.image is not None else -1, np.int32)
        )
        if part.image is not None:
            textures.append(Texture(part.image, repeat=True))
    count = sum(len(part.triangles) for part in parts)
    return Scene(
        vertices=vertices.astype(np.float32),
        triangles=np.concatenate([p.triangles + o for p, o in zip(parts, offsets)]).astype(np.uint32),
        texture_coordinates=np.concatenate([part.coordinates for part in parts]).astype(np.float32),
        texture_ids=np.concatenate(texture_ids),
        tints=np.concatenate([part.tints for part in parts]).astype(np.float32),
        light_coordinates=np.zeros((count, 3, 2), np.float32),
        light_ids=np.full(count, NO_LIGHT, np.int32),
        surfaces=np.arange(count, dtype=np.int32),
        textures=textures,
        description=f"rendered from the mesh {path.name}",
    )


class _Part:
    """One mesh of a model with its material (None: no material)."""

    def __init__(self, path: Path, part: MeshPart) -> None:
        self.vertices, self.triangles = part.vertices, part.triangles
        count = len(self.triangles)
        self.image = None
        self.coordinates = np.zeros((count, 3, 2))
        self.tints = np.ones((count, 3))
        self.coloured = False
        if part.texture is not None:
            if part.texture_coordinates is None:
                raise DataError(f"{path}: has a texture image but no texture coordinates; export it with UVs")
            self.image = _grey(part.texture)
            height, width = self.image.shape
            uv = part.texture_coordinates
            if not np.isfinite(uv).all():
                raise DataError(f"{path}: texture coordinates hold values that are not finite")
            # v points up in files (Open3D turns glTF's, which points down).
            self.coordinates = np.stack([uv[..., 0] * width, (1 - uv[..., 1]) * height], -1)
            self.coloured = True
        if part.colours is not None:
            self.tints = (part.colours @ LUMA)[self.triangles]
            self.coloured = True
        if part.base_colour is not None:
            base = part.base_colour
            if path.suffix.lower() == ".obj" and self.coloured and np.allclose(base, READER_DEFAULT):
                base = np.ones(3)  # the material library gave no Kd
            self.tints = self.tints * (base @ LUMA)
        if not np.isfinite(self.tints).all():
            raise DataError(f"{path}: its colours hold values that are not finite")


def _grey(image: np.ndarray) -> np.ndarray:  # [H, W] float32 in [0, 1]
    """Return a texture image as grey."""
    largest = 255.0 if image.dtype == np.uint8 else 65535.0 if image.dtype == np.uint16 else 1.0
    values = image.astype(np.float64) / largest
    if values.ndim == 3:
        values = values[..., :3] @ LUMA if values.shape[2] >= 3 else values[..., 0]
    return np.ascontiguousarray(np.clip(values, 0, 1), np.float32)
