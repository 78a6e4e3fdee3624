"""An Open3D window that follows a run, and what draws into such windows."""

import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from edslam_ti.errors import EdSlamError
from edslam_ti.geometry import inverse
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.viewer.moment import Moment
from edslam_ti.viewer.shapes import (
    KEYFRAME_COLOUR,
    PATH_COLOUR,
    frustum_lines,
    keyframe_indices,
    opening_view,
    path_lines,
    rgb,
)

MAP_EVERY = 5  # the window fetches the map points at every n-th frame
WIDTH, HEIGHT = 1280, 720  # pixels of the window
FOCAL = 625.0  # pixels: 60 degrees from top to bottom


class Open3dViewer:
    """An Open3D window that follows a run: trajectory, keyframe frusta and map points."""

    def __init__(self, title: str = "ED-SLAM") -> None:
        """Open the window, or raise EdSlamError where that is impossible."""
        check_display()
        self._o3d = o3d = load_open3d()
        self._window = o3d.visualization.Visualizer()
        if not self._window.create_window(window_name=title, width=WIDTH, height=HEIGHT):
            raise EdSlamError("Open3D could not open a window (no OpenGL?); run without --visualize")
        self._path = o3d.geometry.LineSet()
        self._frusta = o3d.geometry.LineSet()
        self._cloud = o3d.geometry.PointCloud()
        self._shown: list[Any] = []
        self._num_updates = 0

    def update(self, moment: Moment) -> None:
        """Show the state of the run and return at once."""
        trajectory, mapper = moment.trajectory, moment.mapper
        if len(trajectory) < 2:
            return
        fill_lines(self._o3d, self._path, path_lines(trajectory.poses[:, :3, 3]), PATH_COLOUR)
        keyframes = [trajectory.pose(k) for k in keyframe_indices(mapper, len(trajectory))]
        poses = [*keyframes, trajectory.pose(-1)]
        frusta = [line for T in poses for line in frustum_lines(T, moment.camera)]
        fill_lines(self._o3d, self._frusta, frusta, KEYFRAME_COLOUR)
        shapes = [self._path, self._frusta]
        if mapper is not None and self._num_updates % MAP_EVERY == 0:
            points, brightness = mapper.points()
            if len(points):
                fill_cloud(self._o3d, self._cloud, points, brightness)
                shapes.append(self._cloud)
        self._num_updates += 1
        for shape in shapes:
            if any(shape is shown for shown in self._shown):
                self._window.update_geometry(shape)
            else:
                self._window.add_geometry(shape, reset_bounding_box=True)
                self._shown.append(shape)
                look_from(self._o3d, self._window, trajectory.poses)
        self._window.poll_events()
        self._window.update_renderer()

    def wait(self, is_ended: Callable[[], bool]) -> None:
        """Return at once."""

    def close(self) -> None:
        """Close the window."""
        self._window.destroy_window()


def look_from(o3d: Any, window: Any, poses: np.ndarray) -> None:  # [F, 4, 4]
    """Set the view of a window to where the first camera stood, with the whole path in sight."""
    parameters = o3d.camera.PinholeCameraParameters()
    centre = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    parameters.intrinsic = o3d.camera.PinholeCameraIntrinsic(WIDTH, HEIGHT, FOCAL, FOCAL, *centre)
    parameters.extrinsic = inverse(opening_view(poses, HEIGHT / 2 / FOCAL, WIDTH / 2 / FOCAL))
    # The size of the window may have been changed by now.
    window.get_view_control().convert_from_pinhole_camera_parameters(parameters, allow_arbitrary=True)


def check_display() -> None:
    """Raise EdSlamError where no window can be opened."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise EdSlamError(
            "no display for a window (neither DISPLAY nor WAYLAND_DISPLAY is set); run without "
            "--visualize, watch in a browser with --viewer, and draw finished runs with: "
            "edslam view RESULT --save FILE.png"
        )


def fill_lines(o3d: Any, shape: Any, lines: Sequence[np.ndarray], color: str) -> None:
    """Set an Open3D LineSet to lines [2, 3] of one colour, #rrggbb."""
    shape.points = o3d.utility.Vector3dVector(np.concatenate(lines))
    shape.lines = o3d.utility.Vector2iVector(np.arange(2 * len(lines), dtype=np.int32).reshape(-1, 2))
    shape.paint_uniform_color([value / 255 for value in rgb(color)])


def fill_cloud(o3d: Any, cloud: Any, points: np.ndarray, brightness: np.ndarray) -> None:
    """Set an Open3D PointCloud to points [N, 3] in grey [N]."""
    cloud.points = o3d.utility.Vector3dVector(np.asarray(points, np.float64))
    grey = np.clip(np.reshape(brightness, (-1, 1)), 0, 1)
    cloud.colors = o3d.utility.Vector3dVector(np.repeat(grey, 3, axis=1).astype(np.float64))
