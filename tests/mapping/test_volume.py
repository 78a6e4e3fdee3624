"""TSDF volume: where its surface lies, and how a mesh is seen."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.mapping.volume import MeshView, TsdfVolume

CAMERA = Camera(width=160, height=120, fx=130.0, fy=130.0, cx=75.0, cy=63.0)
NORMAL = np.array([0.3, 0.2, -1.0])


def plane_view() -> tuple[np.ndarray, np.ndarray]:
    """Return depth and brightness of the plane NORMAL . p = -1.5 with stripes over the columns."""
    depth = (-1.5 / (CAMERA.rays() @ NORMAL)).astype(np.float32)
    brightness = np.tile(stripes(np.arange(CAMERA.width)), (CAMERA.height, 1))
    return depth, brightness


def stripes(x: np.ndarray) -> np.ndarray:
    return np.sin(x / 6) * 0.5 + 0.5


@pytest.fixture(scope="module")
def plane_mesh() -> object:
    volume = TsdfVolume(CAMERA, voxel_size=0.02)
    for _ in range(3):
        volume.integrate(*plane_view(), np.eye(4))
    return volume.mesh()


def test_mesh_of_a_plane_lies_on_it(plane_mesh) -> None:
    vertices = np.asarray(plane_mesh.vertices)
    distance = np.abs(vertices @ NORMAL + 1.5) / np.linalg.norm(NORMAL)
    assert distance.mean() < 0.001  # a twentieth of a voxel; half a pixel of shift gives 0.0028


def test_mesh_colours_are_those_of_the_nearest_pixels(plane_mesh) -> None:
    vertices = np.asarray(plane_mesh.vertices)
    x = vertices[:, 0] / vertices[:, 2] * CAMERA.fx + CAMERA.cx
    colors = np.asarray(plane_mesh.vertex_colors)[:, 0]

    def error(shift: float) -> float:
        return float(np.abs(stripes(x + shift) - colors).mean())

    # Nearest-pixel lookup is symmetric: a shift of half a pixel either way must be worse.
    assert error(0.0) < 0.015
    assert error(0.0) < 0.5 * min(error(-0.5), error(0.5))


def test_view_of_the_mesh_returns_the_fused_depth_and_brightness(plane_mesh) -> None:
    depth, brightness = plane_view()
    seen_brightness, seen_depth = MeshView(plane_mesh).render(CAMERA, np.eye(4))
    seen = seen_depth > 0
    assert seen.mean() > 0.9  # the rim of the image has no complete voxels
    assert np.median(np.abs(seen_depth - depth)[seen]) < 0.001
    assert np.abs(seen_brightness - brightness)[seen].mean() < 0.015


def test_view_from_the_side_has_depth_along_the_optical_axis(plane_mesh) -> None:
    T = np.eye(4)
    T[:3, 3] = [0.1, 0.05, -0.3]
    _, depth = MeshView(plane_mesh).render(CAMERA, T)
    expected = -(1.5 + NORMAL @ T[:3, 3]) / (CAMERA.rays() @ NORMAL)
    assert np.median(np.abs(depth - expected)[depth > 0]) < 0.001


def test_empty_volume_has_an_empty_mesh_and_a_black_view() -> None:
    volume = TsdfVolume(CAMERA, voxel_size=0.02)
    volume.integrate(np.zeros(CAMERA.shape), np.zeros(CAMERA.shape), np.eye(4))
    mesh = volume.mesh()
    assert len(mesh.triangles) == 0
    brightness, depth = MeshView(mesh).render(CAMERA, np.eye(4))
    assert not brightness.any()
    assert not depth.any()


def test_wrong_sizes_are_errors() -> None:
    volume = TsdfVolume(CAMERA, voxel_size=0.02)
    with pytest.raises(DataError, match="depth: expected shape"):
        volume.integrate(np.ones((3, 3)), np.ones(CAMERA.shape), np.eye(4))
    with pytest.raises(DataError, match="voxel_size"):
        TsdfVolume(CAMERA, voxel_size=0.0)


def test_kinect_frames_with_true_poses_fuse_into_one_surface(shared_data: Path) -> None:
    folder = shared_data / "red_kitchen" / "frames"
    if not folder.is_dir():
        pytest.skip(f"real RGB-D recording not found at {folder}")
    camera = Camera(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0).downscaled(4)
    volume = TsdfVolume(camera, voxel_size=0.03)
    views = []
    for k in range(0, 40, 4):
        depth = cv2.imread(str(folder / f"frame-{k:06d}.depth.png"), -1)[2::4, 2::4] / 1000.0
        depth[depth > 10] = 0  # 65.535 m marks missing depth
        grey = cv2.imread(str(folder / f"frame-{k:06d}.color.jpg"), 0)[2::4, 2::4] / 255.0
        views.append((depth, grey, np.loadtxt(folder / f"frame-{k:06d}.pose.txt")))
        volume.integrate(*views[-1])
    depth, grey, T_world_camera = views[5]
    brightness, seen = MeshView(volume.mesh()).render(camera, T_world_camera)
    both = (seen > 0) & (depth > 0)
    assert both.mean() > 0.8
    # Kinect noise is 1-2 cm at 2-3 m; the surface must agree within a voxel.
    assert np.median(np.abs(seen - depth)[both]) < 0.03
    assert np.corrcoef(brightness[both], grey[both])[0, 1] > 0.9


def test_view_with_hardly_any_depth_is_passed_over() -> None:
    # Open3D looks for surfaces at every fourth pixel, and calls finding none an error.
    depth = np.zeros(CAMERA.shape)
    depth[41, 42] = 1.5
    volume = TsdfVolume(CAMERA, voxel_size=0.02)
    volume.integrate(depth, depth, np.eye(4))
    assert volume.num_frames == 0
    assert len(volume.mesh().triangles) == 0
