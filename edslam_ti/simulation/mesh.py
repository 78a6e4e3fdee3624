"""Loads textured or vertex-coloured meshes (obj, ply, glb, ...) as scenes with Open3D.

Brightness is the file's colour (base colour x texture x vertex colour) without shading, because colours of
scanned meshes such as Replica's contain the light. Axes are the file's (glTF: y up; many scans: z up).
"""

from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.simulation.scene import NO_LIGHT, Scene, Texture

LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601, as OpenCV converts colour to grey
READER_DEFAULT = 0.6  # base colour that Open3D's obj reader (Assimp) reports where a material has no Kd
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
        _check_obj_textures(path)
    parts = _read_parts(path)
    if not parts:
        raise DataError(
            f"{path}: Open3D found no triangles in it; is it a mesh (not a point cloud) and whole?"
        )
    if not any(part.coloured for part in parts):
        raise DataError(
            f"{path}: expected a texture or vertex colours, found neither; "
            "export the mesh with its texture image (obj + mtl + png, glb) or with vertex colours (ply)"
        )
    vertices = np.concatenate([part.vertices for part in parts]) * scale
    if not np.isfinite(vertices).all():
        raise DataError(f"{path}: vertices hold values that are not finite; repair the mesh")
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


def _read_parts(path: Path) -> list["_Part"]:
    """Return the non-empty meshes of a file."""
    o3d = load_open3d()
    if path.suffix.lower() in (".ply", ".off", ".stl"):  # no materials; polygons (Replica's quads) are cut up
        mesh = o3d.io.read_triangle_mesh(str(path))
        return [_Part(path, mesh, None)] if len(mesh.triangles) else []
    model = o3d.io.read_triangle_model(str(path))
    return [
        _Part(path, m.mesh, model.materials[m.material_idx]) for m in model.meshes if len(m.mesh.triangles)
    ]


class _Part:
    """One mesh of a model with its material (None: no material)."""

    def __init__(self, path: Path, mesh: Any, material: Any) -> None:
        self.vertices = np.asarray(mesh.vertices)
        self.triangles = np.asarray(mesh.triangles)
        count = len(self.triangles)
        image = None if material is None else material.albedo_img
        self.image = None
        self.coordinates = np.zeros((count, 3, 2))
        self.tints = np.ones((count, 3))
        self.coloured = False
        if image is not None and not image.is_empty():
            if not mesh.has_triangle_uvs():
                raise DataError(f"{path}: has a texture image but no texture coordinates; export it with UVs")
            self.image = _grey(np.asarray(image))
            height, width = self.image.shape
            uv = np.asarray(mesh.triangle_uvs).reshape(count, 3, 2)
            # v points up in files (Open3D flips glTF's, which points down).
            self.coordinates = np.stack([uv[..., 0] * width, (1 - uv[..., 1]) * height], -1)
            self.coloured = True
        if mesh.has_vertex_colors():
            self.tints = (np.asarray(mesh.vertex_colors) @ LUMA)[self.triangles]
            self.coloured = True
        if material is not None:
            base = np.array(material.base_color, np.float64)[:3]
            if path.suffix.lower() == ".obj" and self.coloured and np.allclose(base, READER_DEFAULT):
                base = np.ones(3)  # the material library gave no Kd
            self.tints = self.tints * (base @ LUMA)


def _grey(image: np.ndarray) -> np.ndarray:  # [H, W] float32 in [0, 1]
    """Return a texture image as grey."""
    largest = 255.0 if image.dtype == np.uint8 else 65535.0 if image.dtype == np.uint16 else 1.0
    values = image.astype(np.float64) / largest
    if values.ndim == 3:
        values = values[..., :3] @ LUMA if values.shape[2] >= 3 else values[..., 0]
    return np.ascontiguousarray(np.clip(values, 0, 1), np.float32)


def _check_obj_textures(path: Path) -> None:
    """Raise if a material library or a texture named in an obj file is missing; Open3D only warns."""
    libraries = _values(path, "mtllib")
    for library in libraries:
        file = path.parent / library
        if not file.is_file():
            raise DataError(f"{path}: its material library '{library}' is missing; put it next to the mesh")
        for texture in _values(file, "map_Kd"):
            name = texture.split()[-1] if texture.startswith("-") else texture
            if not (path.parent / name.replace("\\", "/")).is_file():
                raise DataError(f"{file}: its texture '{name}' is missing; put it next to the mesh")


def _values(path: Path, keyword: str) -> list[str]:
    """Return the rest of every line that starts with a keyword."""
    found = []
    with path.open(errors="replace") as file:
        for line in file:
            words = line.strip().split(maxsplit=1)
            if len(words) == 2 and words[0] == keyword:
                found.append(words[1])
    return found
