"""Whether the texture images that mesh files name are there and whole: Open3D only warns, or paints black."""

import base64
import binascii
import json
import struct
import urllib.parse
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edslam_ti.errors import DataError, plain

PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8"
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942  # glTF 2.0, Sec. 4.4.3


def check_obj_textures(path: Path) -> None:
    """Raise `DataError` when a material library or a texture that an obj names is missing or damaged."""
    for library in _values(path, "mtllib"):
        file = path.parent / library
        if not file.is_file():
            raise DataError(
                f"{path}: its material library '{plain(library)}' is missing; put it beside the mesh"
            )
        for texture in _values(file, "map_Kd"):
            name = texture.split()[-1] if texture.startswith("-") else texture
            image = path.parent / name.replace("\\", "/")
            if not image.is_file():
                raise DataError(f"{file}: its texture '{plain(name)}' is missing; put it beside the mesh")
            check_image(str(image), image.read_bytes())


def check_glb_textures(path: Path) -> None:
    """Raise `DataError` when an image that a glb or gltf holds or names is missing or damaged."""
    document, binary = _gltf(path)
    for number, image in enumerate(_dictionaries(document, "images")):
        name = f"{path}: image {number}"
        if "uri" in image:
            check_image(name, _resource(path, str(image["uri"])))
            continue
        view = _item(document, "bufferViews", image.get("bufferView"), name)
        buffer = _item(document, "buffers", view.get("buffer"), name)
        data = _resource(path, str(buffer["uri"])) if "uri" in buffer else binary
        start, length = view.get("byteOffset", 0), view.get("byteLength", 0)
        are_numbers = isinstance(start, int) and isinstance(length, int)
        if not (are_numbers and 0 <= start <= start + length <= len(data)):
            raise DataError(f"{name}: lies outside the file's data; the file is damaged")
        check_image(name, data[start : start + length])


def check_image(name: str, data: bytes) -> None:
    """Raise `DataError` unless an image is whole; decoders return the upper part of one that is cut off."""
    fault = None
    if data.startswith(PNG):
        fault = _png_fault(data)
    elif data.startswith(JPEG) and b"\xff\xd9" not in data[-65536:]:
        fault = "it is cut off: the mark at a JPEG's end is missing"
    if fault is None:
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
        except cv2.error:
            image = None
        if image is not None:
            return
        fault = "it is empty" if not data else "no decoder knows it"
    raise DataError(f"{name}: not readable as a texture image: {fault}; export the mesh again")


def _png_fault(data: bytes) -> str | None:
    """Return what is wrong with the chunks of a PNG (ISO 15948, Sec. 5.3), None when they are whole."""
    place = len(PNG)
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        kind = data[place + 4 : place + 8]
        if place + 12 + length > len(data):
            break
        (stated,) = struct.unpack_from(">I", data, place + 8 + length)
        if zlib.crc32(data[place + 4 : place + 8 + length]) != stated:
            return f"the checksum of its part at byte {place} is wrong"
        if kind == b"IEND":
            return None
        place += 12 + length
    return "it is cut off"


def _gltf(path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the document and the binary chunk (empty in a .gltf)."""
    data = path.read_bytes()
    text, binary = data, b""
    if path.suffix.lower() == ".glb":
        if len(data) < 20 or data[:4] != b"glTF":
            raise DataError(f"{path}: expected a binary glTF file, it begins with {plain(data[:4])}")
        (stated,) = struct.unpack_from("<I", data, 8)
        if stated > len(data):
            raise DataError(f"{path}: its header says {stated} bytes, it has {len(data)}; is it cut off?")
        chunks: dict[int, bytes] = {}
        place = 12
        while place + 8 <= stated:
            length, kind = struct.unpack_from("<II", data, place)
            if place + 8 + length > stated:
                raise DataError(f"{path}: its part at byte {place} reaches beyond its end; it is damaged")
            chunks.setdefault(kind, data[place + 8 : place + 8 + length])
            place += 8 + length
        text, binary = chunks.get(JSON_CHUNK, b""), chunks.get(BINARY_CHUNK, b"")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not readable as glTF: its JSON is damaged ({plain(error)})") from error
    if not isinstance(document, dict):
        raise DataError(f"{path}: not readable as glTF: expected a JSON object")
    return document, binary


def _dictionaries(document: dict[str, Any], key: str) -> list[dict[str, Any]]:
    items = document.get(key, [])
    if not isinstance(items, list):
        return []
    return [item if isinstance(item, dict) else {} for item in items]


def _item(document: dict[str, Any], key: str, number: Any, name: str) -> dict[str, Any]:
    items = _dictionaries(document, key)
    if not isinstance(number, int) or not 0 <= number < len(items):
        raise DataError(f"{name}: refers to {key} {plain(number)}, there are {len(items)}; it is damaged")
    return items[number]


def _resource(path: Path, uri: str) -> bytes:
    """Return what a glTF's URI names: data inside it, or a file beside it."""
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except (binascii.Error, ValueError) as error:
            raise DataError(f"{path}: data inside it is not base64; the file is damaged") from error
    file = path.parent / urllib.parse.unquote(uri)
    if not file.is_file():
        raise DataError(f"{path}: its file '{plain(uri)}' is missing; put it beside the mesh")
    return file.read_bytes()


def _values(path: Path, keyword: str) -> list[str]:
    """Return what follows a keyword at the start of a line."""
    found = []
    with path.open(errors="replace") as file:
        for line in file:
            words = line.strip().split(maxsplit=1)
            if len(words) == 2 and words[0] == keyword:
                found.append(words[1])
    return found
