"""An object that moves in view, and the renderer of a scene with it."""

from dataclasses import dataclass

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.simulation import textures as tx
from edslam_ti.simulation.paths import CameraPath, TourPath
from edslam_ti.simulation.renderer import Render, Renderer
from edslam_ti.simulation.rooms import Room, stretched
from edslam_ti.simulation.scene import Scene, SceneBuilder

AHEAD = 2.0  # metres that the object goes ahead of the camera on a walk
SIZE = (0.42, 0.42, 1.25)  # metres
PERIOD = 5.0  # seconds for its way there and back, where there is no walk
REACH = 0.72  # of the way from the middle of the free space to what the camera looks at
PLACES_PER_SECOND = 20


@dataclass(frozen=True)
class MovingObject:
    """A thing that moves through a scene, with no light of its own baked: T_world_object by time."""

    scene: Scene  # in the object's frame, z up, its foot at the origin
    places: np.ndarray  # [P, 3] metres, at even times of one period
    period: float  # seconds
    turns: float  # about itself per period

    def pose(self, t: float) -> np.ndarray:  # [4, 4]
        """Return T_world_object at a time in seconds."""
        u = (t / self.period) % 1.0
        ring = np.concatenate([self.places, self.places[:1]])
        at = u * len(self.places)
        k = int(at)
        angle = 2 * np.pi * self.turns * u
        T = np.eye(4)
        T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        T[:3, 3] = ring[k] + (at - k) * (ring[k + 1] - ring[k])
        return T


def moving_object(room: Room, path: CameraPath) -> MovingObject:
    """Return a patterned box that goes ahead of the camera on its walk, or to and fro between the sights."""
    builder = SceneBuilder(seed=301)
    x, y, z = SIZE
    side = stretched(builder, tx.abstract(builder.rng))
    builder.box((-x / 2, -y / 2, 0.02), (x / 2, y / 2, z), side)
    scene = builder.build("moving box")
    if isinstance(path, TourPath):
        count = max(2, round(path.duration * PLACES_PER_SECOND))
        places = np.array(
            [path.walk.at(path.walked(path.duration * k / count) + AHEAD) for k in range(count)]
        )
        places[:, 2] = 0
        return MovingObject(scene, places, path.duration, turns=float(path.rounds))
    centre = (room.free_low + room.free_high) / 2
    ends = centre + REACH * (room.sights[[0, len(room.sights) // 2]] - centre)
    share = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(100) / 100)  # there and back, gently
    places = ends[0] + share[:, None] * (ends[1] - ends[0])
    places[:, 2] = 0
    return MovingObject(scene, places, PERIOD, turns=1.0)


class MovingRenderer:
    """Renders a scene and an object that moves in it; the nearer of the two is seen.

    The object's outline is not anti-aliased: its pixels show it where their centres hit it.
    """

    def __init__(
        self, scene: Scene, moving: MovingObject | None, camera: Camera, samples_per_edge_pixel: int
    ) -> None:
        self._static = Renderer(scene, camera, samples_per_edge_pixel)
        self._moving = moving
        self._object = None if moving is None else Renderer(moving.scene, camera, 1)

    def render(self, T_world_camera: np.ndarray, t: float) -> Render:  # [4, 4], seconds
        """Return image and depth from a pose at a time."""
        behind = self._static.render(T_world_camera)
        if self._moving is None or self._object is None:
            return behind
        T_world_object = self._moving.pose(t)
        ahead = self._object.render(np.linalg.inv(T_world_object) @ T_world_camera)
        return behind.covered_by(ahead, T_world_object)
