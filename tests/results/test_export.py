"""Files for other programs: points and meshes."""

from pathlib import Path

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.results.export import fuse_mesh, write_mesh, write_points


def test_empty_map_is_an_error_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no points"):
        write_points(tmp_path / "points.ply", np.empty((0, 3)), np.empty((0, 1)))
    with pytest.raises(DataError, match="no surface"):
        write_mesh(tmp_path / "mesh.ply", load_open3d().geometry.TriangleMesh())
    assert list(tmp_path.iterdir()) == []


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
