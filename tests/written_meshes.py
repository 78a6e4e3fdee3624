"""Small textured meshes on disk."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)


def write_textured_square(folder: Path, texture: str = "square.png") -> Path:
    """A unit square at y = 1 whose texture is dark on the left and bright at the top right."""
    image = np.full((32, 32, 3), 60, np.uint8)
    image[:16, 16:] = 220
    cv2.imwrite(str(folder / "square.png"), image)
    (folder / "square.mtl").write_text(f"newmtl paint\nmap_Kd {texture}\n")
    (folder / "square.obj").write_text(
        "mtllib square.mtl\nv -1 1 -1\nv 1 1 -1\nv 1 1 1\nv -1 1 1\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl paint\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    return folder / "square.obj"


def write_glb(path: Path, attributes: dict[str, np.ndarray], material: dict, image: Path | None) -> None:
    """Write two triangles as binary glTF 2.0, its texture inside."""
    parts = [array.astype("<f4").tobytes() for array in attributes.values()]
    parts.append(np.array([0, 1, 2, 0, 2, 3], "<u4").tobytes())
    accessors = [
        {"bufferView": k, "componentType": 5126, "count": 4, "type": f"VEC{array.shape[1]}",
         "min": array.min(0).tolist(), "max": array.max(0).tolist()}
        for k, array in enumerate(attributes.values())
    ]  # fmt: skip
    accessors.append({"bufferView": len(attributes), "componentType": 5125, "count": 6, "type": "SCALAR"})
    primitive = {
        "attributes": {name: k for k, name in enumerate(attributes)},
        "indices": len(attributes),
        "material": 0,
    }
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [0, 0, -1]}], "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": material}], "accessors": accessors,
    }  # fmt: skip
    if image is not None:
        parts.append(image.read_bytes())
        document["images"] = [{"bufferView": len(parts) - 1, "mimeType": "image/png"}]
        document["textures"] = [{"source": 0}]
    views, offset = [], 0
    for k, part in enumerate(parts):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(part)})
        parts[k] = part + b"\0" * (-len(part) % 4)
        offset += len(parts[k])
    document["bufferViews"], document["buffers"] = views, [{"byteLength": offset}]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(parts)
    chunks = (
        struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    )
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
