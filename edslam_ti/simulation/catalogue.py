"""Built-in scenes by name: five rooms that stand in for EventReplica's, and scenes reserved for tests."""

from edslam_ti.errors import DataError
from edslam_ti.simulation.flat import flat
from edslam_ti.simulation.rooms import ROOM_NAMES, ROOMS, Room
from edslam_ti.simulation.unseen import UNSEEN_SCENES

UNSEEN_NAMES = tuple(UNSEEN_SCENES)
UNSEEN_ROOM_NAMES = tuple(name for name in UNSEEN_NAMES if name not in ("wall", "corridor"))
SCENE_NAMES = (*ROOM_NAMES, *UNSEEN_NAMES, "flat")


def make_room(name: str) -> Room:
    """Return a built-in scene; the same name always gives the same scene."""
    builders = ROOMS | UNSEEN_SCENES | {"flat": flat}
    if name not in builders:
        raise DataError(f"scene '{name}': no such built-in scene; choose from {', '.join(SCENE_NAMES)}")
    return builders[name]()
