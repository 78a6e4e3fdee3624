"""A coloured mesh as binary glTF 2.0 (Khronos Group), which browsers, Blender and phones open.

The vertices keep the coordinates of the trajectory. Where it says so, the node turns them so that the
cameras' up direction becomes glTF's, which is y. Colours are shown as they are, without lights.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.errors import DataError
from edslam_ti.output import atomic_file

MAGIC, VERSION = 0x46546C67, 2
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
FLOAT, UINT32, UINT16 = 5126, 5125, 5123  # OpenGL's names of types
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963  # what a part of the buffer is for
UNLIT = "KHR_materials_unlit"


def write_glb(
    path: Path,
    vertices: np.ndarray,  # [V, 3] metres
    triangles: np.ndarray,  # [T, 3] indices
    colors: np.ndarray,  # [V, 3] in [0, 1], as pictures have them (sRGB)
    up: np.ndarray | None = None,  # [3] in the coordinates of the vertices; None: y
) -> None:
    """Write a mesh with vertex colours; raises DataError where there is none."""
    if len(vertices) == 0 or len(triangles) == 0:
        raise DataError(f"{path.name}: expected a mesh, got {len(vertices)} vertices, {len(triangles)} faces")
    positions = np.ascontiguousarray(vertices, "<f4")
    # glTF's vertex colours are linear; 16 bits keep the dark ones apart.
    linear = np.rint(65535 * linear_of_srgb(np.clip(colors, 0, 1))).astype("<u2")
    rgba = np.concatenate([linear, np.full((len(linear), 1), 65535, "<u2")], axis=1)
    parts = [positions.tobytes(), rgba.tobytes(), np.ascontiguousarray(triangles, "<u4").tobytes()]
    offsets = np.cumsum([0, *map(len, parts)])  # all are multiples of 4 bytes
    node: dict[str, Any] = {"mesh": 0, "name": "mesh"}
    if up is not None:
        node["rotation"] = _turn(up).tolist()
    document = {
        "asset": {"version": "2.0", "generator": "edslam"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "extensionsUsed": [UNLIT],
        "materials": [{"extensions": {UNLIT: {}}, "doubleSided": True}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}
        ],
        "accessors": [
            {
                **{"bufferView": 0, "componentType": FLOAT, "count": len(positions), "type": "VEC3"},
                **{"min": positions.min(0).tolist(), "max": positions.max(0).tolist()},
            },
            {
                **{"bufferView": 1, "componentType": UINT16, "count": len(rgba), "type": "VEC4"},
                "normalized": True,
            },
            {"bufferView": 2, "componentType": UINT32, "count": int(np.size(triangles)), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": len(part), "target": target}
            for start, part, target in zip(offsets, parts, (ARRAY_BUFFER, ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER))
        ],
        "buffers": [{"byteLength": int(offsets[-1])}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<III", MAGIC, VERSION, 12 + 8 + len(text) + 8 + int(offsets[-1])))
        file.write(struct.pack("<II", len(text), JSON_CHUNK) + text)
        file.write(struct.pack("<II", int(offsets[-1]), BINARY_CHUNK) + b"".join(parts))


def linear_of_srgb(colors: np.ndarray) -> np.ndarray:  # [...] in [0, 1]
    """Return linear colours (IEC 61966-2-1)."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def _turn(up: np.ndarray) -> np.ndarray:  # [3] -> [4] xyzw
    """Return the smallest rotation that brings a direction to y."""
    direction = up / np.linalg.norm(up)
    axis = np.cross(direction, [0, 1, 0])
    if np.linalg.norm(axis) < 1e-9:  # it is y, or its opposite
        return np.array([0.0, 0, 0, 1]) if direction[1] > 0 else np.array([1.0, 0, 0, 0])
    angle = np.arccos(np.clip(direction[1], -1, 1))
    return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_quat()
