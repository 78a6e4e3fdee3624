"""Shows a run on a screen: the interface of viewers, and an Open3D window."""

import os
import sys
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import EdSlamError
from edslam_ti.geometry import inverse
from edslam_ti.mapping.mapper import Mapper
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.trajectory import Trajectory

PATH_COLOUR, KEYFRAME_COLOUR = "#0072B2", "#D55E00"  # colour-blind safe (Okabe and Ito)
MAP_EVERY = 5  # the window fetches the map points at every n-th frame
FRUSTUM_EVERY = 10  # frames between the frusta of a map without keyframes
WIDTH, HEIGHT = 1280, 720  # pixels of the window
FOCAL = 625.0  # pixels: 60 degrees from top to bottom


class Viewer(Protocol):
    """Shows a run in progress."""

    def update(self, trajectory: Trajectory, mapper: Mapper | None, camera: Camera) -> None:
        """Show the state of the run after a frame, and return at once."""

    def close(self) -> None:
        """Stop showing, because the run has been saved."""


class NoViewer:
    """Shows nothing."""

    def update(self, trajectory: Trajectory, mapper: Mapper | None, camera: Camera) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


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

    def update(self, trajectory: Trajectory, mapper: Mapper | None, camera: Camera) -> None:
        """Show the state of the run and return at once."""
        if len(trajectory) < 2:
            return
        fill_lines(self._o3d, self._path, path_lines(trajectory.poses[:, :3, 3]), PATH_COLOUR)
        keyframes = [trajectory.pose(k) for k in _keyframe_indices(mapper, len(trajectory))]
        frusta = [line for T in [*keyframes, trajectory.pose(-1)] for line in frustum_lines(T, camera)]
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
                self._look_from(trajectory.pose(0))
        self._window.poll_events()
        self._window.update_renderer()

    def close(self) -> None:
        """Close the window."""
        self._window.destroy_window()

    def _look_from(self, T_world_camera: np.ndarray) -> None:
        """Set the view of the window to that of a camera."""
        parameters = self._o3d.camera.PinholeCameraParameters()
        centre = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
        parameters.intrinsic = self._o3d.camera.PinholeCameraIntrinsic(WIDTH, HEIGHT, FOCAL, FOCAL, *centre)
        parameters.extrinsic = inverse(T_world_camera)
        control = self._window.get_view_control()
        # The size of the window may have been changed by now.
        control.convert_from_pinhole_camera_parameters(parameters, allow_arbitrary=True)


# By name; a viewer is made when a run starts and may raise EdSlamError.
VIEWERS: dict[str, Callable[[], Viewer]] = {"none": NoViewer, "open3d": Open3dViewer}


def check_display() -> None:
    """Raise EdSlamError where no window can be opened."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise EdSlamError(
            "no display for a window (neither DISPLAY nor WAYLAND_DISPLAY is set); run without "
            "--visualize, and draw finished runs with: edslam view RESULT --save FILE.png"
        )


def _keyframe_indices(mapper: Mapper | None, num_frames: int) -> list[int]:
    """Return the map's keyframes; every tenth frame for a map without keyframes."""
    keyframes = [] if mapper is None else mapper.keyframe_indices()
    return keyframes or list(range(0, num_frames, FRUSTUM_EVERY))


# --- shapes ---


def path_lines(positions: np.ndarray) -> list[np.ndarray]:  # [F, 3] -> F - 1 lines [2, 3]
    """Return the segments of a path."""
    return [positions[k : k + 2] for k in range(len(positions) - 1)]


def frustum_lines(T_world_camera: np.ndarray, camera: Camera, size: float = 0.05) -> list[np.ndarray]:
    """Return the eight edges [2, 3] of a camera's pyramid, `size` metres deep."""
    left, right, top, bottom = -0.5, camera.width - 0.5, -0.5, camera.height - 0.5
    u, v = np.array([left, right, right, left]), np.array([top, top, bottom, bottom])
    corners = camera.back_project_pixels(u, v, np.ones(4))  # [4, 3]
    apex = T_world_camera[:3, 3]
    base = size * corners @ T_world_camera[:3, :3].T + apex
    return [np.stack([base[k], base[(k + 1) % 4]]) for k in range(4)] + [np.stack([apex, b]) for b in base]


def fill_lines(o3d: Any, shape: Any, lines: Sequence[np.ndarray], color: str) -> None:
    """Set an Open3D LineSet to lines [2, 3] of one colour, #rrggbb."""
    shape.points = o3d.utility.Vector3dVector(np.concatenate(lines))
    shape.lines = o3d.utility.Vector2iVector(np.arange(2 * len(lines), dtype=np.int32).reshape(-1, 2))
    shape.paint_uniform_color([int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)])


def fill_cloud(o3d: Any, cloud: Any, points: np.ndarray, brightness: np.ndarray) -> None:
    """Set an Open3D PointCloud to points [N, 3] in grey [N]."""
    cloud.points = o3d.utility.Vector3dVector(np.asarray(points, np.float64))
    grey = np.clip(np.reshape(brightness, (-1, 1)), 0, 1)
    cloud.colors = o3d.utility.Vector3dVector(np.repeat(grey, 3, axis=1).astype(np.float64))
