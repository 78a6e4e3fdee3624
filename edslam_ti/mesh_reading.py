"""Meshes and point clouds from files that may be damaged, read through Open3D.

Open3D's readers end the process where a file is damaged in some ways. PLY files of points and triangles are
checked first; all others are read in a child process, where a crash is an error like any other.
"""

import contextlib
import json
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.errors import DataError, plain
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.ply_check import is_sound_ply

TIMEOUT = 600  # seconds for a reader; the largest scans take some ten
MEMORY = 16 << 30  # bytes of address space for a reader, and as many again for each byte of the file:
MEMORY_PER_BYTE = 64
START = (
    "import sys, json; sys.path[:] = json.loads(sys.argv[1]); "
    "from edslam_ti.mesh_reading import _child; _child(*sys.argv[2:])"
)


@dataclass(frozen=True)
class MeshPart:
    """Triangles of one material."""

    vertices: np.ndarray  # [V, 3] float64, the file's unit
    triangles: np.ndarray  # [T, 3] int32
    colours: np.ndarray | None = None  # [V, 3] float64 in [0, 1]
    normals: np.ndarray | None = None  # [V, 3] float64
    texture_coordinates: np.ndarray | None = None  # [T, 3, 2] float64, v up
    texture: np.ndarray | None = None  # [H, W] or [H, W, C] as stored
    base_colour: np.ndarray | None = None  # [3] float64; None: no material


def read_triangle_mesh(path: Path) -> Any:
    """Return the Open3D TriangleMesh in a file without materials (ply, off, stl): checked, never empty."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: mesh not found")
    o3d = load_open3d()
    if path.suffix.lower() == ".ply" and is_sound_ply(path):
        mesh = o3d.io.read_triangle_mesh(str(path))
    else:
        mesh = o3d.geometry.TriangleMesh()
        for part in _read_in_child("mesh", path):
            mesh.vertices = o3d.utility.Vector3dVector(part.vertices)
            mesh.triangles = o3d.utility.Vector3iVector(part.triangles)
            if part.colours is not None:
                mesh.vertex_colors = o3d.utility.Vector3dVector(part.colours)
            if part.normals is not None:
                mesh.vertex_normals = o3d.utility.Vector3dVector(part.normals)
    _check(path, np.asarray(mesh.vertices), np.asarray(mesh.triangles))
    if not len(mesh.triangles):
        raise _no_triangle(path)
    return mesh


def read_point_cloud(path: Path) -> Any:
    """Return the Open3D PointCloud in a file: checked, never empty."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: point cloud not found")
    o3d = load_open3d()
    if path.suffix.lower() == ".ply" and is_sound_ply(path):
        cloud = o3d.io.read_point_cloud(str(path))
    else:
        cloud = o3d.geometry.PointCloud()
        for part in _read_in_child("points", path):
            cloud.points = o3d.utility.Vector3dVector(part.vertices)
            if part.colours is not None:
                cloud.colors = o3d.utility.Vector3dVector(part.colours)
            if part.normals is not None:
                cloud.normals = o3d.utility.Vector3dVector(part.normals)
    if not len(cloud.points):
        raise DataError(f"{path}: expected a point cloud, could not read any point")
    _check(path, np.asarray(cloud.points), np.empty((0, 3), int))
    return cloud


def read_model(path: Path) -> list[MeshPart]:
    """Return the non-empty parts of a mesh file with or without materials: at least one, checked."""
    if not path.is_file():
        raise FileNotFoundError(f"mesh {path} not found")
    if path.suffix.lower() in (".ply", ".off", ".stl"):
        return [_part(read_triangle_mesh(path))]
    parts = _read_in_child("model", path)
    for part in parts:
        _check(path, part.vertices, part.triangles)
    if not parts:
        raise _no_triangle(path)
    return parts


def _no_triangle(path: Path) -> DataError:
    return DataError(
        f"{path}: expected a mesh, could not read any triangle: it holds no triangles (a point cloud?), or "
        "is damaged"
    )


def _check(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Raise `DataError` unless vertices are finite and triangles name vertices that are there."""
    if not np.isfinite(vertices).all():
        bad = int(np.argmax(~np.isfinite(vertices).all(1)))
        raise DataError(f"{path}: vertex {bad} (counted from 0) is not finite: {vertices[bad].tolist()}")
    wrong = ((triangles < 0) | (triangles >= len(vertices))).any(1)
    if wrong.any():
        bad = int(np.argmax(wrong))
        raise DataError(
            f"{path}: triangle {bad} (counted from 0) names the vertices {triangles[bad].tolist()}; expected "
            f"0 to {len(vertices) - 1}"
        )


def _part(mesh: Any, material: Any = None) -> MeshPart:
    """Return the arrays of an Open3D TriangleMesh or PointCloud with its material."""
    triangles = np.asarray(mesh.triangles) if hasattr(mesh, "triangles") else np.empty((0, 3), np.int32)
    points = mesh.vertices if hasattr(mesh, "vertices") else mesh.points
    colours = mesh.vertex_colors if hasattr(mesh, "vertices") else mesh.colors
    normals = mesh.vertex_normals if hasattr(mesh, "vertices") else mesh.normals
    has_coordinates = hasattr(mesh, "triangle_uvs") and mesh.has_triangle_uvs()
    image = None if material is None else material.albedo_img
    return MeshPart(
        vertices=np.asarray(points),
        triangles=triangles,
        colours=np.asarray(colours) if len(colours) == len(points) > 0 else None,
        normals=np.asarray(normals) if len(normals) == len(points) > 0 else None,
        texture_coordinates=np.asarray(mesh.triangle_uvs).reshape(-1, 3, 2) if has_coordinates else None,
        texture=np.asarray(image) if image is not None and not image.is_empty() else None,
        base_colour=None if material is None else np.array(material.base_color, np.float64)[:3],
    )


def _read_in_child(kind: str, path: Path) -> list[MeshPart]:
    """Return what another process reads; its crash is a `DataError`."""
    with tempfile.TemporaryDirectory(prefix="edslam_ti-mesh-") as folder:
        result = Path(folder) / "parts.npz"
        memory = str(MEMORY + MEMORY_PER_BYTE * path.stat().st_size)
        command = [sys.executable, "-c", START, json.dumps(sys.path), kind, str(path), str(result), memory]
        try:
            done = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, timeout=TIMEOUT)
        except subprocess.TimeoutExpired as error:
            raise DataError(f"{path}: not read as a mesh within {TIMEOUT} s; is the file damaged?") from error
        if done.returncode < 0 or not result.is_file():
            last = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
            reason = f" ({plain(last[0])})" if last and done.returncode > 0 else ""
            raise DataError(
                f"{path}: not readable as a mesh: the reader crashed{reason}; the file is damaged"
            )
        complaint = re.search(rb"RPly: (.*)", done.stdout + done.stderr)
        if complaint is not None:  # what it returns then is partly memory that nobody has written
            raise DataError(f"{path}: not readable as a mesh: {plain(complaint[1].decode(errors='replace'))}")
        with np.load(result) as arrays:
            parts: list[dict[str, np.ndarray]] = [{} for _ in range(int(arrays["count"]))]
            for name in arrays.files:
                number, _, key = name.partition(" ")
                if key:
                    parts[int(number)][key] = arrays[name]
    return [MeshPart(**part) for part in parts]


def _child(kind: str, path: str, result: str, memory: str) -> None:
    """Read a file in this process, and write its parts as arrays '<number> <field>'."""
    with contextlib.suppress(ImportError, ValueError, OSError):  # Windows; a smaller limit holds already
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    o3d = load_open3d()
    if kind == "model":
        model = o3d.io.read_triangle_model(path)
        parts = [
            _part(m.mesh, model.materials[m.material_idx]) for m in model.meshes if len(m.mesh.triangles)
        ]
    elif kind == "mesh":
        parts = [_part(o3d.io.read_triangle_mesh(path))]
    else:
        parts = [_part(o3d.io.read_point_cloud(path))]
    arrays: dict[str, Any] = {"count": np.array(len(parts))}
    for number, part in enumerate(parts):
        arrays |= {f"{number} {name}": value for name, value in vars(part).items() if value is not None}
    with open(result + ".partial", "wb") as file:
        np.savez(file, **arrays)
    Path(result + ".partial").rename(result)
