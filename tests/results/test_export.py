"""Files for other programs: splats, points, meshes."""

from pathlib import Path

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.results.export import (
    SPLAT_PROPERTIES,
    fuse_mesh,
    read_gaussian_ply,
    write_gaussian_ply,
    write_mesh,
    write_points,
)


def gaussians(count: int = 5, channels: int = 1) -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    quats = random.normal(size=(count, 4))
    return {
        "means": random.normal(size=(count, 3)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "log_scales": random.normal(size=(count, 3)) - 4,
        "logit_opacities": random.normal(size=count),
        "colors": random.random((count, channels)),
    }


def test_splat_file_reads_back_what_was_written(tmp_path: Path) -> None:
    written = gaussians(channels=3)
    write_gaussian_ply(tmp_path / "map.ply", **written)
    read = read_gaussian_ply(tmp_path / "map.ply")
    assert read.keys() == written.keys()
    for name, values in written.items():
        np.testing.assert_allclose(read[name], values, atol=1e-6, err_msg=name)


def test_splat_file_is_the_3dgs_layout_to_the_byte(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_gaussian_ply(path, **gaussians(count=2))
    header, body = path.read_bytes().split(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\n")
    names = [line.split()[2].decode() for line in header.splitlines() if line.startswith(b"property float ")]
    assert names == list(SPLAT_PROPERTIES)
    assert len(body) == 2 * 17 * 4
    row = dict(zip(names, np.frombuffer(body, "<f4")[:17]))
    grey = gaussians(count=2)["colors"][0, 0]
    assert row["nx"] == row["ny"] == row["nz"] == 0
    # Viewers show 0.5 + 0.282 f_dc, exp(scale), sigmoid(opacity), and rot_0 is w.
    assert row["f_dc_0"] == row["f_dc_1"] == row["f_dc_2"]
    assert 0.5 + 0.28209479177387814 * row["f_dc_0"] == pytest.approx(grey, abs=1e-6)
    assert row["rot_0"] == pytest.approx(gaussians(count=2)["quats"][0, 0], abs=1e-6)


def test_splat_file_is_a_point_cloud_to_open3d(tmp_path: Path) -> None:
    write_gaussian_ply(tmp_path / "map.ply", **gaussians())
    cloud = load_open3d().io.read_point_cloud(str(tmp_path / "map.ply"))
    np.testing.assert_allclose(np.asarray(cloud.points), gaussians()["means"], atol=1e-6)


def test_quaternions_are_normalised_in_the_file(tmp_path: Path) -> None:
    values = gaussians()
    values["quats"] = values["quats"] * 3
    write_gaussian_ply(tmp_path / "map.ply", **values)
    np.testing.assert_allclose(
        read_gaussian_ply(tmp_path / "map.ply")["quats"], gaussians()["quats"], atol=1e-6
    )


def test_empty_map_is_an_error_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no Gaussians"):
        write_gaussian_ply(tmp_path / "map.ply", **gaussians(count=0))
    with pytest.raises(DataError, match="no points"):
        write_points(tmp_path / "points.ply", np.empty((0, 3)), np.empty((0, 1)))
    with pytest.raises(DataError, match="no surface"):
        write_mesh(tmp_path / "mesh.ply", load_open3d().geometry.TriangleMesh())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "logit_opacities", "colors"])
def test_not_a_number_is_not_exported(tmp_path: Path, name: str) -> None:
    values = gaussians()
    values[name].reshape(-1)[3] = np.nan
    with pytest.raises(DataError, match=name):
        write_gaussian_ply(tmp_path / "map.ply", **values)
    assert list(tmp_path.iterdir()) == []


def test_wrong_shapes_are_named(tmp_path: Path) -> None:
    values = gaussians()
    values["quats"] = values["quats"][:, :3]
    with pytest.raises(DataError, match=r"quats: expected shape \(5, 4\), got \(5, 3\)"):
        write_gaussian_ply(tmp_path / "map.ply", **values)


@pytest.mark.parametrize(
    "content",
    [b"", b"not a ply", b"ply\nformat ascii 1.0\nend_header\n", b"ply\nformat binary_little_endian 1.0\n"],
)
def test_foreign_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "map.ply").write_bytes(content)
    with pytest.raises(DataError, match="binary little endian"):
        read_gaussian_ply(tmp_path / "map.ply")


def test_truncated_and_incomplete_splat_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_gaussian_ply(path, **gaussians())
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    with pytest.raises(DataError, match="truncated"):
        read_gaussian_ply(path)
    path.write_bytes(whole.replace(b"property float rot_3", b"property float other"))
    with pytest.raises(DataError, match="rot_3"):
        read_gaussian_ply(path)
    with pytest.raises(FileNotFoundError):
        read_gaussian_ply(tmp_path / "absent.ply")


def test_points_read_back_with_their_brightness(tmp_path: Path) -> None:
    points = np.random.default_rng(2).normal(size=(7, 3))
    brightness = np.linspace(0, 1, 7)
    write_points(tmp_path / "points.ply", points, brightness)
    cloud = load_open3d().io.read_point_cloud(str(tmp_path / "points.ply"))
    np.testing.assert_allclose(np.asarray(cloud.points), points, atol=1e-6)
    # PLY stores colours in 8 bits.
    np.testing.assert_allclose(np.asarray(cloud.colors), np.tile(brightness[:, None], 3), atol=1 / 255)


def test_views_fuse_into_a_mesh_file(tmp_path: Path) -> None:
    camera = Camera(width=80, height=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
    view = (np.full(camera.shape, 1.0, np.float32), np.full(camera.shape, 0.5), np.eye(4))
    write_mesh(tmp_path / "mesh.ply", fuse_mesh([view, view], camera, voxel_size=0.02))
    mesh = load_open3d().io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    vertices = np.asarray(mesh.vertices)
    np.testing.assert_allclose(vertices[:, 2], 1.0, atol=0.002)
    assert np.ptp(vertices[:, 0]) == pytest.approx(80 / 70, abs=0.08)  # to within two voxels per side
    np.testing.assert_allclose(np.asarray(mesh.vertex_colors), 0.5, atol=1 / 255 + 1e-6)


def test_no_views_give_a_mesh_that_is_refused(tmp_path: Path) -> None:
    camera = Camera(width=8, height=6, fx=7.0, fy=7.0, cx=3.5, cy=2.5)
    with pytest.raises(DataError, match="no surface"):
        write_mesh(tmp_path / "mesh.ply", fuse_mesh([], camera, voxel_size=0.02))
