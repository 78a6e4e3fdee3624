"""An object that moves in view, and the renderer of a scene with it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.lenses import Lens
from edslam_ti.simulation import textures as tx
from edslam_ti.simulation.paths import CameraPath, TourPath
from edslam_ti.simulation.renderer import Render, Renderer
from edslam_ti.simulation.rooms import Room, stretched
from edslam_ti.simulation.scene import Scene, SceneBuilder

AHEAD = 2.0  # metres that the object goes ahead of the camera on a walk
SIZE = (0.42, 0.42, 1.25)  # metres
PERIOD = 5.0  # seconds for its way there and back, where there is no walk
REACH = 0.72  # of the way from the middle of the free space to what the camera looks at
TURN_RATE = 0.4  # radians per second


@dataclass(frozen=True)
class MovingObject:
    """A thing that moves through a scene, upright and turning; no light of its own is baked."""

    scene: Scene  # in the object's frame, z up, its foot at the origin
    place: Callable[[float], np.ndarray]  # seconds -> [3] metres
    turn_rate: float  # radians per second

    def pose(self, t: float) -> np.ndarray:  # [4, 4]
        """Return T_world_object at a time in seconds."""
        c, s = np.cos(self.turn_rate * t), np.sin(self.turn_rate * t)
        T = np.eye(4)
        T[:2, :2] = [[c, -s], [s, c]]
        T[:3, 3] = self.place(t)
        return T


def moving_object(room: Room, path: CameraPath) -> MovingObject:
    """Return a patterned box that goes ahead of the camera on its walk, or to and fro between the sights."""
    builder = SceneBuilder(seed=301)
    x, y, z = SIZE
    side = stretched(builder, tx.abstract(builder.rng))
    builder.box((-x / 2, -y / 2, 0.02), (x / 2, y / 2, z), side)
    centre = (room.free_low + room.free_high) / 2
    first, last = centre + REACH * (room.sights[[0, len(room.sights) // 2]] - centre)

    def to_and_fro(t: float) -> np.ndarray:  # [3] metres
        share = 0.5 - 0.5 * np.cos(2 * np.pi * t / PERIOD)
        return np.array((*(first + share * (last - first))[:2], 0.0))

    def ahead(t: float) -> np.ndarray:  # [3] metres
        assert isinstance(path, TourPath)
        return np.array((*path.walk.at(path.walked(t) + AHEAD)[:2], 0.0))

    place = ahead if isinstance(path, TourPath) else to_and_fro
    return MovingObject(builder.build("moving box"), place, TURN_RATE)


class MovingRenderer:
    """Renders a scene and an object that moves in it; the nearer of the two is seen.

    The object's outline is not anti-aliased: its pixels show it where their centres hit it.
    """

    def __init__(
        self,
        scene: Scene,
        moving: MovingObject | None,
        camera: Camera,
        samples_per_edge_pixel: int,
        lens: Lens | None = None,
    ) -> None:
        self._static = Renderer(scene, camera, samples_per_edge_pixel, lens=lens)
        self._moving = moving
        self._object = None if moving is None else Renderer(moving.scene, camera, 1, lens=lens)

    def render(self, T_world_camera: np.ndarray, t: float) -> Render:  # [4, 4], seconds
        """Return image and depth from a pose at a time."""
        behind = self._static.render(T_world_camera)
        if self._moving is None or self._object is None:
            return behind
        T_world_object = self._moving.pose(t)
        ahead = self._object.render(np.linalg.inv(T_world_object) @ T_world_camera)
        return behind.covered_by(ahead, T_world_object)
