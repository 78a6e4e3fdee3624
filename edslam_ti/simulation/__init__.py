"""Simulated recordings: procedural rooms or meshes, camera paths, events, depth and images."""

from edslam_ti.simulation.catalogue import SCENE_NAMES, UNSEEN_NAMES, make_room
from edslam_ti.simulation.mesh import load_mesh
from edslam_ti.simulation.paths import CameraPath, HandHeldPath, RecordedPath, look_at, make_path
from edslam_ti.simulation.recording import RecordingSummary, simulate
from edslam_ti.simulation.rooms import ROOM_NAMES, Room
from edslam_ti.simulation.scene import Scene
from edslam_ti.simulation.settings import SimulationConfig

__all__ = [
    "ROOM_NAMES",
    "SCENE_NAMES",
    "UNSEEN_NAMES",
    "CameraPath",
    "HandHeldPath",
    "RecordedPath",
    "RecordingSummary",
    "Room",
    "Scene",
    "SimulationConfig",
    "load_mesh",
    "look_at",
    "make_path",
    "make_room",
    "simulate",
]
