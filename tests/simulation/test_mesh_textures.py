"""Texture images that are cut off, damaged or missing are refused, wherever a mesh keeps them."""

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from written_meshes import SQUARE, write_glb, write_textured_square

from edslam_ti.errors import DataError
from edslam_ti.simulation import load_mesh
from edslam_ti.simulation.mesh_textures import check_image

IMAGE = np.random.default_rng(0).integers(0, 255, (40, 50, 3)).astype(np.uint8)


def encoded(suffix: str) -> bytes:
    return bytes(cv2.imencode(suffix, IMAGE)[1])


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_whole_images_pass_and_cut_ones_do_not(suffix: str) -> None:
    data = encoded(suffix)
    check_image("whole", data)
    for length in (0, 1, 10, len(data) // 2, len(data) * 9 // 10, len(data) - 3):
        with pytest.raises(DataError, match=r"cut: not readable as a texture image: .*; export"):
            check_image("cut", data[:length])


def test_every_flipped_bit_of_a_png_is_noticed() -> None:
    data = encoded(".png")
    for place in np.random.default_rng(0).integers(0, len(data), 50):
        flipped = bytearray(data)
        flipped[place] ^= 4
        with pytest.raises(DataError):
            check_image("flipped", bytes(flipped))


def test_a_cut_texture_of_an_obj_is_refused(tmp_path: Path) -> None:
    mesh = write_textured_square(tmp_path)
    data = (tmp_path / "square.png").read_bytes()
    (tmp_path / "square.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError, match=r"square\.png: not readable as a texture image: it is cut off"):
        load_mesh(mesh)


def test_a_damaged_texture_of_a_glb_is_refused(tmp_path: Path) -> None:
    image = tmp_path / "image.png"
    image.write_bytes(encoded(".png")[:-100])
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    material = {"baseColorTexture": {"index": 0}}
    write_glb(tmp_path / "s.glb", {"POSITION": SQUARE, "TEXCOORD_0": uv}, material, image)
    with pytest.raises(DataError, match=r"s\.glb: image 0: not readable as a texture image: it is cut off"):
        load_mesh(tmp_path / "s.glb")


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"images": [{"uri": "lost.png"}]}, "its file 'lost.png' is missing; put it beside the mesh"),
        ({"images": [{"uri": "data:image/png;base64,%%%"}]}, "is not base64"),
        ({"images": [{"uri": "data:image/png;base64,AAAA"}]}, "no decoder knows it"),
        ({"images": [{"bufferView": 7}]}, "refers to bufferViews 7, there are 0"),
        ({"images": [{"bufferView": 0}], "bufferViews": [{"buffer": -1}]}, "refers to buffers -1"),
        ({"images": ["x"]}, "refers to bufferViews None"),
        (
            {
                "images": [{"bufferView": 0}],
                "bufferViews": [{"buffer": 0, "byteOffset": 10**12, "byteLength": 5}],
                "buffers": [{"uri": "data:;base64," + base64.b64encode(b"abc").decode()}],
            },
            "lies outside the file's data",
        ),
        ([1], "expected a JSON object"),
    ],
)
def test_references_that_lead_nowhere_are_refused(tmp_path: Path, document: object, message: str) -> None:
    path = tmp_path / "m.gltf"
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match=message):
        load_mesh(path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "expected a binary glTF file"),
        (b"glTF" + b"\xff" * 16, "its header says 4294967295 bytes, it has 20"),
        (b"glTF\2\0\0\0\x18\0\0\0\xff\xff\0\0JSON{}  ", "reaches beyond its end"),
        (b"glTF\2\0\0\0\x18\0\0\0\4\0\0\0JSON{x  ", "its JSON is damaged"),
    ],
)
def test_damaged_glb_files_are_refused(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "m.glb").write_bytes(data)
    with pytest.raises(DataError, match=message):
        load_mesh(tmp_path / "m.glb")


def test_deep_json_is_refused(tmp_path: Path) -> None:
    (tmp_path / "m.gltf").write_text("[" * 100_000)
    with pytest.raises(DataError, match="its JSON is damaged"):
        load_mesh(tmp_path / "m.gltf")


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-5, 1e6])
def test_scenes_of_absurd_size_are_refused(tmp_path: Path, scale: float) -> None:
    with pytest.raises(DataError, match=r"expected a scene of 0\.001 to 1e\+06 m, not .* check its scale"):
        load_mesh(write_textured_square(tmp_path), scale)
