"""Runs for other programs, read back by readers that are not ours."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from evo.tools import file_interface
from saved_results import CAMERA, curve, write_result

from edslam_ti.camera import Camera
from edslam_ti.commands.export import main
from edslam_ti.errors import DataError
from edslam_ti.geometry import inverse
from edslam_ti.mapping.gaussian_ply import write_gaussian_ply
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.results.gltf import linear_of_srgb, write_glb
from edslam_ti.results.other_formats import FORMATS, Exporter
from edslam_ti.results.reading import read_camera_of, write_camera

POINT = np.array([0.3, -0.2, 1.5])  # metres, in view of every pose of `curve`


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = write_result(tmp_path)
    write_camera(folder, CAMERA)
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(50, 4))
    write_gaussian_ply(
        folder / "map.ply",
        rng.normal(size=(50, 3)),
        quats,
        np.log(rng.uniform(0.01, 0.1, (50, 3))),
        rng.normal(size=50),
        rng.uniform(0, 1, 50),
    )
    return folder


def test_all_formats_are_written_by_one_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([str(folder), "--images", "true"])
    names = {path.name for path in (folder / "export").iterdir()}
    assert names == {
        *("map.splat", "mesh.glb", "trajectory_kitti.txt", "times.txt", "colmap", "transforms.json"),
        "images",
    }
    assert len(capsys.readouterr().out.splitlines()) == len(names)
    image = cv2.imread(str(folder / "export/images/frame_00039.png"), cv2.IMREAD_UNCHANGED)
    assert image.shape == CAMERA.shape
    assert image.std() > 0


def test_what_a_run_lacks_is_left_out_and_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("map.ply", "mesh.ply", "camera.json"):
        (folder / name).unlink()
    main([str(folder), "--out", str(folder / "o")])
    assert {path.name for path in (folder / "o").iterdir()} == {"trajectory_kitti.txt", "times.txt"}
    printed = capsys.readouterr().out
    for name in ("splat", "glb", "colmap", "nerfstudio"):
        assert f"left out: {name}: " in printed
    with pytest.raises(DataError, match=r"no camera.json"):
        main([str(folder), "--formats", "colmap"])


def test_camera_comes_back(tmp_path: Path) -> None:
    camera = Camera(100, 80, 91.25, 90.5, 47.125, 40.75)
    write_camera(tmp_path, camera)
    assert read_camera_of(tmp_path) == camera


def test_kitti_poses_are_what_evo_reads(folder: Path) -> None:
    path, times = FORMATS["kitti"](Exporter(folder, folder / "o"))
    read = file_interface.read_kitti_poses_file(str(path))
    expected = inverse(curve().pose(0)) @ curve().poses
    np.testing.assert_allclose(read.poses_se3, expected, atol=1e-6)  # the folder's TUM file has 9 decimals
    np.testing.assert_allclose(np.loadtxt(times), curve().timestamps, atol=1e-6)


def test_colmap_model_projects_a_point_to_the_same_pixel(folder: Path) -> None:
    (model,) = FORMATS["colmap"](Exporter(folder, folder / "o"))
    _, kind, *numbers = (model / "cameras.txt").read_text().splitlines()[1].split()
    width, height, fx, fy, cx, cy = map(float, numbers)
    assert (kind, width, height) == ("PINHOLE", CAMERA.width, CAMERA.height)
    lines = (model / "images.txt").read_text().splitlines()[1::2]
    assert len(lines) == len(curve())
    for line, T_world_camera in zip(lines, curve().poses):
        w, x, y, z, *translation = map(float, line.split()[1:8])
        # COLMAP's own formula of a rotation matrix, row by row
        R = np.array(
            [
                [1 - 2 * y * y - 2 * z * z, 2 * x * y - 2 * w * z, 2 * x * z + 2 * w * y],
                [2 * x * y + 2 * w * z, 1 - 2 * x * x - 2 * z * z, 2 * y * z - 2 * w * x],
                [2 * x * z - 2 * w * y, 2 * y * z + 2 * w * x, 1 - 2 * x * x - 2 * y * y],
            ]
        )
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        pixel, _ = cv2.projectPoints(POINT, cv2.Rodrigues(R)[0], np.array(translation), K, None)
        np.testing.assert_allclose(pixel.ravel() - 0.5, pixel_of(POINT, T_world_camera), atol=1e-3)
    points = np.loadtxt(model / "points3D.txt")
    assert points.shape == (500, 8)
    assert points[:, 4:7].max() == 255


def test_nerfstudio_cameras_see_a_point_at_the_same_pixel(folder: Path) -> None:
    (path,) = FORMATS["nerfstudio"](Exporter(folder, folder / "o"))
    document = json.loads(path.read_text())
    assert document["frames"][3]["file_path"] == "images/frame_00003.png"
    for frame, T_world_camera in zip(document["frames"], curve().poses, strict=True):
        x, y, z, _ = np.linalg.inv(np.array(frame["transform_matrix"])) @ [*POINT, 1]
        assert z < 0  # OpenGL's cameras look along -z
        u = document["fl_x"] * x / -z + document["cx"]
        v = document["cy"] - document["fl_y"] * y / -z  # and their y is up
        np.testing.assert_allclose([u - 0.5, v - 0.5], pixel_of(POINT, T_world_camera), atol=1e-3)


def pixel_of(point: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    u, v, z = CAMERA.project((inverse(T_world_camera) @ [*point, 1])[:3])
    assert z > 0.1
    return np.array([u, v])


def test_splat_file_holds_what_the_map_holds(folder: Path) -> None:
    (path,) = FORMATS["splat"](Exporter(folder, folder / "o"))
    rows = [struct.unpack("<3f3f4B4B", path.read_bytes()[k : k + 32]) for k in range(0, 50 * 32, 32)]
    assert path.stat().st_size == 50 * 32
    cloud = load_open3d().t.io.read_point_cloud(str(folder / "map.ply"))  # Open3D reads the 3DGS layout
    means = cloud.point["positions"].numpy()
    scales = cloud.point["scale"].numpy()  # no logarithms any more
    alpha = 1 / (1 + np.exp(-cloud.point["opacity"].numpy().ravel()))
    quats, colours = cloud.point["rot"].numpy(), cloud.point["f_dc"].numpy()
    weights = []
    for row in rows:
        k = int(np.abs(means - row[:3]).sum(1).argmin())
        np.testing.assert_allclose(row[:3], means[k], atol=1e-6)
        np.testing.assert_allclose(row[3:6], scales[k], rtol=1e-5)
        expected = 255 * np.clip([*(0.5 + 0.28209479 * colours[k]), alpha[k]], 0, 1)
        np.testing.assert_allclose(row[6:10], expected, atol=0.51)
        np.testing.assert_allclose((np.array(row[10:14]) - 128) / 128, quats[k], atol=0.009)
        weights.append(scales[k].prod() * alpha[k])
    assert np.all(np.diff(weights) <= 1e-9)  # what covers most comes first


def test_glb_is_read_by_open3d_with_its_colours(folder: Path) -> None:
    exporter = Exporter(folder, folder / "o")
    (path,) = FORMATS["glb"](exporter)
    read = load_open3d().io.read_triangle_mesh(str(path))
    assert len(read.triangles) == len(exporter.result.mesh.triangles)
    # Up is -y of the cameras, so the node is turned by half a turn about x. Open3D sorts vertices.
    positions = np.asarray(exporter.result.mesh.vertices) * [1, -1, -1]
    shown = np.asarray(read.vertices)
    distances = np.linalg.norm(shown[::20, None] - positions[None], axis=2)
    assert distances.min(1).max() < 1e-5
    grey = np.asarray(exporter.result.mesh.vertex_colors)[distances.argmin(1)]
    np.testing.assert_allclose(np.asarray(read.vertex_colors)[::20], linear_of_srgb(grey), atol=0.01)
    header = path.read_bytes()[:20]
    magic, version, length, json_length, _ = struct.unpack("<4sIII4s", header)
    assert (magic, version, length) == (b"glTF", 2, path.stat().st_size)
    document = json.loads(path.read_bytes()[20 : 20 + json_length])
    np.testing.assert_allclose(np.abs(document["nodes"][0]["rotation"]), [1, 0, 0, 0], atol=1e-9)


def test_glb_is_read_by_trimesh(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="trimesh (extra viewer) is not installed")
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 2.0]])
    colours = np.array([[0, 0, 0], [0.5, 0.5, 0.5], [1, 1, 1.0]])
    write_glb(tmp_path / "a.glb", corners, np.array([[0, 1, 2]]), colours, up=np.array([0, 0, 1.0]))
    (mesh,) = trimesh.load_scene(tmp_path / "a.glb").dump()  # with the node's rotation
    np.testing.assert_allclose(mesh.vertices, corners[:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)


def test_mesh_without_faces_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a mesh"):
        write_glb(tmp_path / "a.glb", np.zeros((3, 3)), np.empty((0, 3)), np.zeros((3, 3)))
    assert list(tmp_path.iterdir()) == []
