"""Simulated recordings: procedural rooms or meshes, camera paths, events, depth and images.

The names below load on demand, so that importing the settings loads neither torch nor Taichi.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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

_HOMES = {
    **dict.fromkeys(("SCENE_NAMES", "UNSEEN_NAMES", "make_room"), "catalogue"),
    "load_mesh": "mesh",
    **dict.fromkeys(("CameraPath", "HandHeldPath", "RecordedPath", "look_at", "make_path"), "paths"),
    **dict.fromkeys(("RecordingSummary", "simulate"), "recording"),
    **dict.fromkeys(("ROOM_NAMES", "Room"), "rooms"),
    "Scene": "scene",
    "SimulationConfig": "settings",
}


def __getattr__(name: str) -> Any:
    """Load a public name on first access (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
