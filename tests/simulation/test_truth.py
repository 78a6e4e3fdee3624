"""Views beside the path and true surfaces: what a simulated recording holds for evaluation."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from sequences import TINY, tiny_room

from edslam_ti.datasets import EventDepthSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import DataError
from edslam_ti.geometry import rotation_angle_deg
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.simulation import HandHeldPath, look_at
from edslam_ti.simulation.truth import novel_poses


def test_novel_views_are_near_the_path_and_look_the_same_way(tiny_sequence: EventDepthSequence) -> None:
    views = tiny_sequence.novel_views()
    assert [view.timestamp for view in views] == [0.088, 0.262, 0.438, 0.612]
    for view, distance in zip(views, (0.05, 0.075, 0.1, 0.05)):
        on_path = tiny_sequence.true_pose(view.timestamp)
        assert on_path is not None
        T = np.linalg.inv(on_path) @ view.T_world_camera
        # The path between its written poses is interpolated, which costs a millimetre.
        assert np.linalg.norm(T[:3, 3]) == pytest.approx(distance, abs=2e-3)
        assert rotation_angle_deg(T) == pytest.approx(5, abs=0.1)
        assert T[:3, 2] @ T[:3, 3] < 0  # turned back towards the path


def test_image_and_depth_of_a_view_are_those_of_its_pose(tiny_sequence: EventDepthSequence) -> None:
    o3d = load_open3d()
    surfaces = o3d.t.geometry.RaycastingScene()
    mesh = o3d.io.read_triangle_mesh(str(tiny_sequence.surfaces_file))
    surfaces.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    for view in tiny_sequence.novel_views():
        T, camera = view.T_world_camera, tiny_sequence.camera
        directions = camera.rays() @ T[:3, :3].T
        origins = np.broadcast_to(T[:3, 3], directions.shape)
        rays = np.concatenate([origins, directions], -1).astype(np.float32)
        depth = surfaces.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        assert np.median(np.abs(depth - view.depth)) < 2e-4  # stored in fifths of a millimetre
        assert view.image.std() > 0.05


def test_no_view_lies_inside_an_object() -> None:
    room = tiny_room()
    corner = look_at(np.array([0.07, 1.0, 1.0]), np.array([0.07, 3.0, 1.0]), np.array([0.0, 0.0, 1.0]))
    poses = novel_poses(room.scene, lambda t: corner, 4.0)  # 7 cm from the wall on the left
    assert len(poses) == 10
    assert all(T[0, 3] > 0.06 for _, T in poses)


def test_the_number_of_views_grows_with_the_path_to_a_limit() -> None:
    room = tiny_room()
    path = HandHeldPath(room, 60.0)
    assert len(novel_poses(room.scene, path.pose, TINY.duration)) == 4
    assert len(novel_poses(room.scene, path.pose, 60.0)) == 30


def test_recording_without_views_has_none_and_a_half_copied_one_is_refused(
    tiny_folder: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(tiny_folder, tmp_path / "copy"))
    next((copy / "novel_views" / "depth").iterdir()).unlink()
    with pytest.raises(DataError, match="got 4 images, 3 depth images and 4 poses"):
        EventReplicaSequence(copy).novel_views()
    shutil.rmtree(copy / "novel_views")
    (copy / "surfaces.ply").unlink()
    sequence = EventReplicaSequence(copy)
    assert sequence.novel_views() == []
    assert sequence.surfaces_file is None
