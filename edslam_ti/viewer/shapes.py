"""Lines that stand for paths and cameras, and the view from which a run is first seen."""

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.mapping.mapper import Mapper

PATH_COLOUR, KEYFRAME_COLOUR = "#0072B2", "#D55E00"  # colour-blind safe (Okabe and Ito)
TRUTH_COLOUR = "#7F7F7F"
FRUSTUM_EVERY = 10  # frames between the frusta of a map without keyframes
MARGIN = 0.85  # of half the view: the path stays inside
NEAREST = 0.3  # metres between the eye and the path


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


def keyframe_indices(mapper: Mapper | None, num_frames: int) -> list[int]:
    """Return the map's keyframes; every tenth frame for a map without keyframes."""
    keyframes = [] if mapper is None else mapper.keyframe_indices()
    return keyframes or list(range(0, num_frames, FRUSTUM_EVERY))


def opening_view(
    poses: np.ndarray,  # [F, 4, 4] T_world_camera
    half_height: float,  # tangent of half the angle of view, from the middle to the top
    half_width: float,  # the same to the side
) -> np.ndarray:  # [4, 4] T_world_eye
    """Return the first camera's pose, moved back along its view until the whole path is in sight.

    A point at x, y, z of the first camera is in sight from d behind it where |x| <= (z + d) tan(width) and
    so on, so the largest d that a point asks for is enough for all.
    """
    first = poses[0]
    x, y, z = ((poses[:, :3, 3] - first[:3, 3]) @ first[:3, :3]).T
    needed = (np.abs(x) / (MARGIN * half_width), np.abs(y) / (MARGIN * half_height), NEAREST)
    distance = max(float((near - z).max()) for near in needed)
    view = first.copy()
    view[:3, 3] -= distance * first[:3, 2]
    return view


def up_direction(poses: np.ndarray) -> np.ndarray:  # [F, 4, 4] -> [3]
    """Return the mean of the cameras' up directions, or the axis that it is nearest to within 30 degrees."""
    mean = -poses[:, :3, 1].mean(0)
    if np.linalg.norm(mean) < 1e-6:
        return np.array([0.0, 1, 0])
    mean /= np.linalg.norm(mean)
    k = int(np.abs(mean).argmax())
    axis = np.zeros(3)
    axis[k] = np.sign(mean[k])
    return axis if abs(mean[k]) > np.cos(np.deg2rad(30)) else mean


def rgb(color: str) -> tuple[int, int, int]:
    """Return a colour #rrggbb as three numbers up to 255."""
    r, g, b = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return r, g, b
