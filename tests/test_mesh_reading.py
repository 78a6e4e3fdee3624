"""Damaged meshes and point clouds are refused in one line; a reader that crashes takes nothing with it."""

import re
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edslam_ti import mesh_reading
from edslam_ti.errors import DataError
from edslam_ti.mesh_reading import read_model, read_point_cloud, read_triangle_mesh
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.ply_check import is_sound_ply

ROOT = Path(__file__).parents[1]
POINTS = np.random.default_rng(0).normal(size=(50, 3))
FACES = np.random.default_rng(1).integers(0, 50, (30, 3)).astype(np.int32)


def header(data: bytes) -> int:
    return data.index(b"end_header\n") + 11


@pytest.fixture
def mesh(tmp_path: Path) -> Path:
    """A coloured mesh as the project writes it: binary, little endian."""
    o3d = load_open3d()
    made = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(POINTS), o3d.utility.Vector3iVector(FACES))
    made.vertex_colors = o3d.utility.Vector3dVector(np.full((50, 3), 0.4))
    made.compute_vertex_normals()
    assert o3d.io.write_triangle_mesh(str(tmp_path / "mesh.ply"), made)
    return tmp_path / "mesh.ply"


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    o3d = load_open3d()
    made = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    made.colors = o3d.utility.Vector3dVector(np.full((50, 3), 0.4))
    assert o3d.io.write_point_cloud(str(tmp_path / "points.ply"), made)
    return tmp_path / "points.ply"


def assert_same(read: Any, by_open3d: Any) -> None:
    np.testing.assert_array_equal(np.asarray(read.vertices), np.asarray(by_open3d.vertices))
    np.testing.assert_array_equal(np.asarray(read.triangles), np.asarray(by_open3d.triangles))
    np.testing.assert_array_equal(np.asarray(read.vertex_colors), np.asarray(by_open3d.vertex_colors))
    np.testing.assert_array_equal(np.asarray(read.vertex_normals), np.asarray(by_open3d.vertex_normals))


def test_whole_files_are_read_as_open3d_reads_them(mesh: Path, cloud: Path) -> None:
    o3d = load_open3d()
    assert is_sound_ply(mesh)
    assert_same(read_triangle_mesh(mesh), o3d.io.read_triangle_mesh(str(mesh)))
    assert is_sound_ply(cloud)
    read, same = read_point_cloud(cloud), o3d.io.read_point_cloud(str(cloud))
    np.testing.assert_array_equal(np.asarray(read.points), np.asarray(same.points))
    np.testing.assert_array_equal(np.asarray(read.colors), np.asarray(same.colors))


@pytest.mark.slow
def test_rarer_kinds_are_read_in_a_child_to_the_same_values(mesh: Path, cloud: Path, tmp_path: Path) -> None:
    o3d = load_open3d()
    text = tmp_path / "text.ply"
    assert o3d.io.write_triangle_mesh(str(text), o3d.io.read_triangle_mesh(str(mesh)), write_ascii=True)
    assert not is_sound_ply(text)
    assert_same(read_triangle_mesh(text), o3d.io.read_triangle_mesh(str(text)))
    assert o3d.io.write_point_cloud(str(text), o3d.io.read_point_cloud(str(cloud)), write_ascii=True)
    same = o3d.io.read_point_cloud(str(text))
    np.testing.assert_array_equal(np.asarray(read_point_cloud(text).points), np.asarray(same.points))


def replaced(old: bytes, new: bytes) -> Any:
    return lambda data: data.replace(old, new)


def with_index(value: int) -> Any:
    return lambda data: data[:-4] + struct.pack("<i", value)


DAMAGES: dict[str, tuple[Any, str]] = {
    "cut off": (lambda d: d[:-5], r"its header says 30 rows of 'face', .* but the file ends at byte"),
    "cut in the vertices": (lambda d: d[: header(d) + 100], "rows of 'vertex'"),
    "cut in the header": (lambda d: d[:60], "no line 'end_header'; is the file cut off"),
    "empty": (lambda d: b"", "begins with ''"),
    "vertices 4e9": (replaced(b"vertex 50", b"vertex 4000000000"), "4000000000 rows of 'vertex'"),
    "vertices 1e19": (replaced(b"vertex 50", b"vertex 99999999999999999999"), "no line of a PLY header"),
    "vertices negative": (replaced(b"vertex 50", b"vertex -5"), "no line of a PLY header"),
    "faces 4e9": (replaced(b"face 30", b"face 4000000000"), "4000000000 rows of 'face'"),
    "index too large": (with_index(10**8), r"face 29 .* names the vertices .*100000000\]; expected 0 to 49"),
    "index negative": (with_index(-7), r"face 29 .*names the vertices"),
    "unknown type": (replaced(b"property double x", b"property quux x"), "no line of a PLY header"),
    "nan": (
        lambda d: d[: header(d)] + struct.pack("<d", float("nan")) + d[header(d) + 8 :],
        r"vertex 0 \(counted from 0\) holds a value that is not finite",
    ),
    "no colour green": (replaced(b"uchar green", b"uchar foo"), "colours as red, green, blue, .* no 'green'"),
    "no position y": (replaced(b"double y", b"double foo"), "positions as x, y, z, its header has no 'y'"),
    "another file": (lambda d: b"\x1b]0;title\x07" * 9, r"begins with '\\x1b\]0;title\\x07"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_named(mesh: Path, name: str) -> None:
    damage, message = DAMAGES[name]
    mesh.write_bytes(damage(mesh.read_bytes()).replace(b"list uchar uint", b"list uchar int"))
    if "index" in name:  # the negative one needs a type with a sign
        assert b"uchar int" in mesh.read_bytes()
    with pytest.raises(DataError, match=message) as caught:
        read_triangle_mesh(mesh)
    assert len(str(caught.value)) < 600


@pytest.mark.slow
def test_a_text_file_that_is_cut_off_is_refused(mesh: Path) -> None:
    o3d = load_open3d()
    text = mesh.with_name("text.ply")
    assert o3d.io.write_triangle_mesh(str(text), o3d.io.read_triangle_mesh(str(mesh)), write_ascii=True)
    data = text.read_bytes()
    text.write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(DataError, match=r"text\.ply: not readable as a mesh: "):
        read_triangle_mesh(text)


@pytest.mark.slow
def test_random_bytes_are_refused_or_read_but_never_crash(mesh: Path) -> None:
    """Sound by the check means sound for Open3D: a process of its own reads all that the check lets pass."""
    original = mesh.read_bytes()
    passed = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        data = bytearray(original)
        start = rng.integers(0, len(data))
        length = int(rng.integers(1, 60))
        data[start : start + length] = rng.bytes(len(data[start : start + length]))
        path = mesh.with_name(f"{seed}.ply")
        path.write_bytes(data)
        try:
            if is_sound_ply(path):
                passed.append(str(path))
        except DataError as error:
            assert str(path) in str(error)  # noqa: PT017
    assert passed
    code = "import sys; from edslam_ti.mesh_reading import read_triangle_mesh as r\n"
    code += "for path in sys.argv[1:]: assert len(r(__import__('pathlib').Path(path)).triangles)"
    subprocess.run([sys.executable, "-c", code, *passed], check=True, cwd=ROOT)


def test_a_reader_that_crashes_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "mesh.off"
    path.write_text("OFF\n")
    monkeypatch.setattr(mesh_reading, "START", "import os; os.kill(os.getpid(), 11)")
    message = "not readable as a mesh: the reader crashed; the file is damaged"
    for read in (read_triangle_mesh, read_model, read_point_cloud):
        with pytest.raises(DataError, match=re.escape(f"{path}: {message}")):
            read(path)


def test_a_reader_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "mesh.off"
    path.write_text("OFF\n")
    monkeypatch.setattr(mesh_reading, "START", "import time; time.sleep(60)")
    monkeypatch.setattr(mesh_reading, "TIMEOUT", 0.5)
    with pytest.raises(DataError, match="not read as a mesh within"):
        read_model(path)


@pytest.mark.slow
def test_files_without_content_are_refused(mesh: Path, cloud: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="could not read any triangle"):
        read_triangle_mesh(cloud)
    (tmp_path / "none.obj").write_text("v 0 0 0\n")
    with pytest.raises(DataError, match="could not read any triangle"):
        read_model(tmp_path / "none.obj")
    for read in (read_triangle_mesh, read_point_cloud, read_model):
        with pytest.raises(FileNotFoundError):
            read(tmp_path / "absent.ply")


@pytest.mark.slow
def test_open3d_loads_without_running_a_compiler(tmp_path: Path) -> None:
    """A search for libusb by ctypes would run gcc and ld of the user's PATH."""
    for name in ("gcc", "cc", "ld", "ldconfig", "objdump"):
        (tmp_path / name).write_text(f"#!/bin/sh\ntouch {tmp_path}/ran\nexit 1\n")
        (tmp_path / name).chmod(0o755)
    code = (
        f"import os; os.environ['PATH'] = {str(tmp_path)!r}\n"
        "from edslam_ti.open3d_loader import load_open3d\nload_open3d()"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
    assert not (tmp_path / "ran").exists()
