"""Writes the data of a simulated recording for evaluation only: novel views and the true surfaces.

novel_views/images/frameNNNNNN.png     grey, 8 bit; NNNNNN = milliseconds of the nearby pose on the path
novel_views/depth/frameNNNNNN.png      exact depth, uint16, 5000 units per metre, 0 = missing
novel_views/traj.txt                   camera-to-world pose of every view (16 numbers), in the files' order
surfaces.ply                           the scene's triangles, metres, in the world of the poses
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.lenses import Lens
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.output import atomic_file, atomic_folder
from edslam_ti.ray_casting import RayCaster, rays_from
from edslam_ti.simulation.renderer import Renderer
from edslam_ti.simulation.scene import Scene

DEPTH_UNITS_PER_METRE = 5000  # of the depth PNG; reaches to 13.1 m
INTERVAL = 0.4  # seconds of the path per view
COUNTS = (4, 30)  # views at least and at most
OFFSETS = (0.05, 0.075, 0.1)  # metres from the path in the image plane, in turn
TURN = 5.0  # degrees
DIRECTIONS = 8  # in the image plane, tried in turn until one does not lead into an object
CLEARANCE = 0.05  # metres left free around a view


def write_evaluation_truth(
    folder: Path,
    scene: Scene,
    camera: Camera,
    samples_per_pixel: int,
    pose: Callable[[float], np.ndarray],  # seconds -> T_world_camera [4, 4]
    duration: float,  # seconds
    lens: Lens | None = None,  # that distorts the images, not depth
) -> None:
    """Write `surfaces.ply`, then `novel_views`, into a recording's folder; Taichi must have been started."""
    write_surfaces(folder / "surfaces.ply", scene)
    renderer = Renderer(scene, camera, samples_per_pixel, lens=lens)
    pinhole = renderer if lens is None else Renderer(scene, camera, 1)
    with atomic_folder(folder / "novel_views") as partial:
        for name in ("images", "depth"):
            (partial / name).mkdir()
        lines = []
        for ms, T_world_camera in novel_poses(scene, pose, duration):
            view = renderer.render(T_world_camera)
            depth = view.depth if lens is None else pinhole.render(T_world_camera).depth
            units = np.rint(depth.astype(np.float64) * DEPTH_UNITS_PER_METRE)
            units[units > np.iinfo(np.uint16).max] = 0
            grey = np.rint(255 * np.clip(view.grey, 0, 1)).astype(np.uint8)
            for name, image in (("images", grey), ("depth", units.astype(np.uint16))):
                path = partial / name / f"frame{ms:06d}.png"
                if not cv2.imwrite(str(path), image):
                    raise DataError(f"{path}: could not be written; is the disk full?")
            lines.append(" ".join(f"{value:.12g}" for value in T_world_camera.ravel()) + "\n")
        (partial / "traj.txt").write_text("".join(lines))


def write_surfaces(path: Path, scene: Scene) -> None:
    """Write a scene's triangles without colour."""
    o3d = load_open3d()
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(scene.vertices.astype(np.float64)),
        o3d.utility.Vector3iVector(scene.triangles.astype(np.int32)),
    )
    with atomic_file(path) as temporary:
        if not o3d.io.write_triangle_mesh(str(temporary), mesh):
            raise DataError(f"{path}: could not be written; is the disk full?")


def novel_poses(
    scene: Scene,
    pose: Callable[[float], np.ndarray],  # seconds -> T_world_camera [4, 4]
    duration: float,  # seconds
) -> list[tuple[int, np.ndarray]]:
    """Return (milliseconds, T_world_camera) of views 5 to 10 cm from the path, turned by 5 degrees.

    The directions are evenly distributed in the image plane. If an object is in the way, the next direction
    is tried; if all are blocked, there is no view.
    """
    caster = RayCaster(scene.vertices, scene.triangles)
    count = int(np.clip(round(duration / INTERVAL), *COUNTS))
    result = []
    for k in range(count):
        ms = round(1e3 * duration * (k + 0.5) / count)
        T = pose(ms / 1e3)
        offset = OFFSETS[k % len(OFFSETS)]
        angles = 2 * np.pi * ((3 * k + np.arange(DIRECTIONS)) % DIRECTIONS) / DIRECTIONS
        directions = np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)  # [8, 3] camera
        free = np.flatnonzero(caster.cast(rays_from(T, directions)).distance > offset + CLEARANCE)
        if len(free) == 0:
            continue
        direction = directions[free[0]]
        moved = np.eye(4)
        moved[:3, 3] = offset * direction
        axis = np.array([-direction[1], direction[0], 0.0])  # turn towards the path's view
        moved[:3, :3] = Rotation.from_rotvec(np.radians(-TURN) * axis).as_matrix()
        result.append((ms, T @ moved))
    return result
