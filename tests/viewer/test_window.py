"""Viewers: what the window draws, where it opens, and what happens without a display."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from saved_results import CAMERA, curve, write_result

from edslam_ti.config import Config
from edslam_ti.errors import EdSlamError
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.results.window import show_results
from edslam_ti.trajectory import Trajectory
from edslam_ti.viewer import VIEWERS, Moment, NoViewer, Open3dViewer, Viewer, Viewers, make_viewers
from edslam_ti.viewer.shapes import (
    KEYFRAME_COLOUR,
    frustum_lines,
    opening_view,
    path_lines,
    up_direction,
)
from edslam_ti.viewer.window import fill_cloud, fill_lines

PATH = curve()


class Window:
    """Open3D's window without a screen: it keeps what it is given."""

    def __init__(self) -> None:
        self.shapes: list[Any] = []
        self.num_updates = 0
        self.num_seen = 0  # shapes while a person looks
        self.parameters: Any = None

    def create_window(self, window_name: str, width: int, height: int) -> bool:
        return True

    def add_geometry(self, shape: Any, reset_bounding_box: bool) -> None:
        self.shapes.append(shape)

    def update_geometry(self, shape: Any) -> None:
        assert any(shape is shown for shown in self.shapes)
        self.num_updates += 1

    def get_view_control(self) -> "Window":
        return self

    def convert_from_pinhole_camera_parameters(self, parameters: Any, allow_arbitrary: bool) -> bool:
        self.parameters = parameters
        return True

    def poll_events(self) -> None:
        pass

    def run(self) -> None:
        self.num_seen = len(self.shapes)

    def update_renderer(self) -> None:
        pass

    def destroy_window(self) -> None:
        self.shapes.clear()


class DotMapper:
    """As much of a mapper as a viewer asks for: three points, and the keyframes it is told."""

    def __init__(self, keyframes: list[int]) -> None:
        self._keyframes = keyframes

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        return np.eye(3), np.full(3, 0.5)

    def keyframe_indices(self) -> list[int]:
        return self._keyframes


def moment(trajectory: Trajectory, mapper: DotMapper | None = None) -> Moment:
    slam = SimpleNamespace(trajectory=trajectory, mapper=mapper)
    return Moment(slam, CAMERA, None, len(trajectory))  # type: ignore[arg-type]


@pytest.fixture
def window(monkeypatch: pytest.MonkeyPatch) -> Window:
    window = Window()
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(load_open3d().visualization, "Visualizer", lambda: window)
    return window


def test_window_without_display_is_a_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    if not sys.platform.startswith("linux"):
        pytest.skip("displays are announced by the environment on Linux only")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(EdSlamError, match="no display"):
        make_viewers(Config(visualize=True), lambda line: None)


def test_without_a_viewer_nothing_is_asked_of_the_map() -> None:
    viewer = make_viewers(Config(), lambda line: None)
    viewer.update(None)  # type: ignore[arg-type]
    viewer.wait(lambda: False)
    viewer.close()
    assert all(hasattr(Config(), name) for name in VIEWERS)


def test_no_viewer_does_what_viewers_do() -> None:
    viewer: Viewer = NoViewer()
    viewer.update(moment(PATH))
    viewer.wait(lambda: pytest.fail("nobody can pause it"))
    viewer.close()


def test_viewer_that_fails_is_left_out_and_named() -> None:
    class Broken:
        def __getattr__(self, name: str) -> Any:
            raise OSError("the screen\nis gone")

    lines: list[str] = []
    viewer = Viewers({"viewer": Broken()}, lines.append)
    viewer.update(moment(PATH))
    viewer.update(moment(PATH))
    viewer.close()
    assert lines == ["--viewer has ended: the screen\\nis gone"]


def test_window_shows_path_keyframes_and_points(window: Window) -> None:
    viewer = Open3dViewer()
    viewer.update(moment(PATH, DotMapper([0, 7])))
    path, frusta, cloud = window.shapes
    assert len(path.lines) == 39
    assert len(frusta.lines) == 8 * 3  # two keyframes and the newest pose
    np.testing.assert_allclose(np.asarray(frusta.colors)[0], [0xD5 / 255, 0x5E / 255, 0])
    assert KEYFRAME_COLOUR == "#D55E00"
    assert len(cloud.points) == 3
    viewer.update(moment(PATH, DotMapper([0, 7, 9])))
    assert len(window.shapes) == 3  # refilled, not added again
    assert len(frusta.lines) == 8 * 4
    assert window.num_updates == 2  # points come at every fifth frame
    viewer.close()
    assert window.shapes == []


def test_map_without_keyframes_shows_every_tenth_frame(window: Window) -> None:
    viewer = Open3dViewer()
    viewer.update(moment(PATH, DotMapper([])))
    assert len(window.shapes[1].lines) == 8 * 5  # 0, 10, 20, 30 and the newest


def test_window_opens_where_the_first_camera_stood(window: Window) -> None:
    assert hasattr(load_open3d().visualization.ViewControl, "convert_from_pinhole_camera_parameters")
    start = Trajectory(PATH.timestamps[5:], PATH.poses[5:])
    Open3dViewer().update(moment(start))
    view = np.linalg.inv(window.parameters.extrinsic)
    np.testing.assert_allclose(view[:3, :3], start.pose(0)[:3, :3], atol=1e-12)
    np.testing.assert_allclose(view, opening_view(start.poses, 360 / 625, 640 / 625), atol=1e-12)
    intrinsic = window.parameters.intrinsic
    assert (intrinsic.width, intrinsic.height) == (1280, 720)


def test_finished_runs_open_where_the_first_camera_stood(window: Window, tmp_path: Path) -> None:
    show_results([write_result(tmp_path)])
    assert window.num_seen == 2  # path and mesh
    assert window.shapes == []
    view = np.linalg.inv(window.parameters.extrinsic)
    np.testing.assert_allclose(view, opening_view(PATH.poses, 360 / 625, 640 / 625), atol=1e-6)


@pytest.mark.parametrize("shift", [[0, 0, 0], [0, 0, -5], [4, 0, 0], [0, -3, 1]])
def test_opening_view_has_the_whole_path_in_sight(shift: list[float]) -> None:
    poses = PATH.poses.copy()
    poses[1:, :3, 3] += shift
    view = opening_view(poses, half_height=0.6, half_width=0.9)
    x, y, z = ((poses[:, :3, 3] - view[:3, 3]) @ view[:3, :3]).T
    assert z.min() > 0.2
    assert max(np.abs(y / z).max() / 0.6, np.abs(x / z).max() / 0.9) < 0.86
    along = (poses[0, :3, 3] - view[:3, 3]) @ view[:3, 2]  # straight behind the first camera
    np.testing.assert_allclose(view[:3, 3] + along * view[:3, 2], poses[0, :3, 3], atol=1e-12)


def test_up_is_where_the_cameras_are_upright() -> None:
    np.testing.assert_allclose(up_direction(PATH.poses), [0, -1, 0])
    tilted = PATH.poses.copy()
    tilted[:, :3, 1] = [0, -1, 1]
    np.testing.assert_allclose(up_direction(tilted), np.array([0, 1, -1]) / np.sqrt(2), atol=1e-9)


def test_frustum_opens_from_the_camera_along_its_view() -> None:
    T = PATH.pose(20)
    lines = np.array(frustum_lines(T, CAMERA, size=0.1))  # [8, 2, 3]
    in_camera = (lines - T[:3, 3]) @ T[:3, :3]
    np.testing.assert_allclose(in_camera[4:, 0], 0, atol=1e-12)  # four edges leave the centre,
    np.testing.assert_allclose(in_camera[:4, :, 2], 0.1)  # four lie in the image plane
    # The corners are those of the outer pixels: half a pixel beyond the first and last centres.
    assert np.ptp(in_camera[:4, :, 0]) == pytest.approx(0.1 * CAMERA.width / CAMERA.fx)


def test_window_geometry_holds_paths_and_points() -> None:
    o3d = load_open3d()
    lines, cloud = o3d.geometry.LineSet(), o3d.geometry.PointCloud()
    fill_lines(o3d, lines, path_lines(PATH.poses[:, :3, 3]), "#0072B2")
    assert len(lines.lines) == 39
    fill_lines(o3d, lines, path_lines(PATH.poses[:10][:, :3, 3]), "#0072B2")  # refilled, not appended
    assert len(lines.lines) == len(lines.colors) == 9
    fill_cloud(o3d, cloud, np.zeros((3, 3)), np.array([-1.0, 0.5, 2.0]))
    np.testing.assert_allclose(np.asarray(cloud.colors)[:, 0], [0, 0.5, 1])
