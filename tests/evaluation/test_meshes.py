"""Accuracy and completion of a mesh, on surfaces whose distances are known."""

from pathlib import Path

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.evaluation.meshes import SPACING, TrueSurfaces, seen_pixels, seen_points
from edslam_ti.mesh_reading import read_triangle_mesh
from edslam_ti.open3d_loader import load_open3d

CAMERA = Camera(64, 48, 40.0, 40.0, 31.5, 23.5)


def wall(depth: float, half_width: float = 5.0, right: float | None = None):
    """Return a wall across z, and its right edge moved where wanted."""
    o3d = load_open3d()
    x = half_width if right is None else right
    corners = np.array([[-half_width, -5, depth], [x, -5, depth], [x, 5, depth], [-half_width, 5, depth]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(corners), o3d.utility.Vector3iVector(triangles)
    )


@pytest.fixture(scope="module")
def surfaces(tmp_path_factory) -> TrueSurfaces:
    path = tmp_path_factory.mktemp("truth") / "surfaces.ply"
    load_open3d().io.write_triangle_mesh(str(path), wall(2.0))
    return TrueSurfaces(path)


def test_seen_points_lie_on_the_surface_inside_the_view(surfaces: TrueSurfaces) -> None:
    seen = seen_points(surfaces.views(CAMERA, [np.eye(4)]))
    assert seen[:, 2] == pytest.approx(2.0)
    assert np.abs(seen[:, 0]).max() == pytest.approx(2.0 * 31 / 40, abs=0.06)
    moved = np.eye(4)
    moved[0, 3] = 0.5
    both = seen_points(surfaces.views(CAMERA, [np.eye(4), moved, moved]))
    cells = np.floor(both / SPACING).astype(int)
    assert len(np.unique(cells, axis=0)) == len(both)  # what is seen twice counts once
    assert both[:, 0].max() == pytest.approx(seen[:, 0].max() + 0.5, abs=1e-5)


def test_pixels_are_seen_where_another_camera_looked_and_nothing_was_in_the_way(tmp_path: Path) -> None:
    o3d = load_open3d()
    scene = wall(2.0) + wall(1.0, half_width=0.2)  # a small board in front of the wall, 10 m high
    o3d.io.write_triangle_mesh(str(tmp_path / "a.ply"), scene)
    surfaces = TrueSurfaces(tmp_path / "a.ply")
    beside = np.eye(4)
    beside[0, 3] = 0.5
    depth = surfaces.depth(CAMERA, beside)
    assert set(np.round(np.unique(depth), 4)) == {1.0, 2.0}
    seen = seen_pixels(CAMERA, depth, beside, surfaces.views(CAMERA, [np.eye(4)]))
    x = 0.5 + depth * CAMERA.rays()[..., 0]  # metres, of what each pixel shows
    on_wall = depth > 1.5
    border = 2.0 * CAMERA.cx / CAMERA.fx  # 1.575 m: what the camera at 0 sees of the wall,
    hidden = np.abs(x) < 0.34  # and, of 0.4 m, what the board surely hides
    assert seen[on_wall & (x < border - 0.06) & ~(np.abs(x) < 0.46)].all()
    assert not seen[on_wall & (x > border + 0.06)].any()
    assert not seen[on_wall & hidden].any()
    assert seen[depth < 1.5].all()


def test_mesh_in_front_of_the_surface_is_as_far_in_both_directions(surfaces: TrueSurfaces) -> None:
    seen = seen_points(surfaces.views(CAMERA, [np.eye(4)]))
    errors = surfaces.errors(wall(1.97), seen, np.eye(4))
    assert errors.accuracy_cm == pytest.approx(3.0, abs=1e-3)
    assert errors.completion_cm == pytest.approx(3.0, abs=1e-3)
    assert errors.completion_ratio == 1
    assert surfaces.errors(wall(1.9), seen, np.eye(4)).completion_ratio == 0
    shift = np.eye(4)
    shift[2, 3] = 0.03
    assert surfaces.errors(wall(1.97), seen, shift).accuracy_cm == pytest.approx(0, abs=1e-3)


def test_half_a_mesh_is_accurate_and_half_complete(surfaces: TrueSurfaces) -> None:
    seen = seen_points(surfaces.views(CAMERA, [np.eye(4)]))
    errors = surfaces.errors(wall(2.0, right=0.0), seen, np.eye(4))
    assert errors.accuracy_cm < 1e-3
    # The right half is 0 to 1.55 m away, 5 cm of it near enough.
    assert errors.completion_ratio == pytest.approx(0.5 + 0.5 * 0.05 / 1.55, abs=0.03)
    assert errors.completion_cm == pytest.approx(100 * 0.5 * 1.55 / 2, rel=0.05)


def test_a_mesh_without_triangles_is_refused(surfaces: TrueSurfaces, tmp_path: Path) -> None:
    empty = load_open3d().geometry.TriangleMesh()
    with pytest.raises(DataError, match="got 0 triangles"):
        surfaces.errors(empty, np.zeros((1, 3), np.float32), np.eye(4))
    with pytest.raises(FileNotFoundError, match="mesh not found"):
        read_triangle_mesh(tmp_path / "none.ply")
    (tmp_path / "bad.ply").write_text("no mesh")
    with pytest.raises(DataError, match="could not read any triangle"):
        read_triangle_mesh(tmp_path / "bad.ply")
