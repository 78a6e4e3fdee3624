"""The built-in sequences: simulated once and kept in the user's cache folder."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

from edslam_ti.cache import cached
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.leftovers import remove_leftovers
from edslam_ti.simulation import ROOM_NAMES, SimulationConfig, make_path, make_room, simulate
from edslam_ti.simulation.moving import moving_object
from edslam_ti.simulation.truth import write_evaluation_truth

GENERATOR_VERSION = 2  # increase it when rooms, paths or rendering change, so that sequences are made again

# Settings added since GENERATOR_VERSION was last increased. Their defaults change nothing, so recordings made
# before stay valid.
NEW_SETTINGS = (
    "path",
    "pose_rate",
    "event_gap",
    "depth_gap",
    "compact_events",
    "moving_object",
    "sensor",
    "depth_sensor",
)


class BuiltinSequence(EventReplicaSequence):
    """A built-in sequence in the folder that `builtin_sequence_folder` made."""

    dataset = "builtin"

    def __init__(self, folder: Path, contrast_threshold: float | None = None) -> None:
        super().__init__(folder, contrast_threshold)
        if self.scene in ROOM_NAMES:  # the others describe themselves
            self.description = f"built-in simulated room '{self.scene}', a stand-in for EventReplica's scene"


def builtin_sequence_folder(
    scene: str,
    config: SimulationConfig | None = None,
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Return the folder of a built-in sequence (EventReplica's layout), simulating it on first use.

    `progress` receives the share simulated, 0 to 1; without it there is a bar on the terminal.
    Taichi must have been started. The folder's name contains a hash of the generator's version and of every
    setting, so changed settings never use old data.
    """
    settings = config or SimulationConfig()
    key = f"{GENERATOR_VERSION} {key_of(settings)}"
    version = hashlib.sha256(key.encode()).hexdigest()[:12]
    folder = cached(Path("sequences") / version / scene)
    if (folder / "novel_views").is_dir():  # folders appear whole or not at all
        return folder
    from rich.progress import Progress

    for other in folder.parent.parent.glob("*"):
        remove_leftovers(other)  # a killed process leaves up to a gigabyte
    room = make_room(scene)
    path = make_path(room, settings)
    moving = moving_object(room, path) if settings.moving_object else None
    if folder.is_dir():  # simulated before recordings had novel views
        write_evaluation_truth(
            folder, room.scene, settings.camera, settings.samples_per_pixel, path.pose, settings.duration
        )
        return folder
    if progress is not None:
        simulate(room.scene, path, settings, folder, progress, moving)
        return folder
    with Progress(transient=True) as bar:
        task = bar.add_task(f"simulating {scene} (first use)", total=1.0)

        def show(share: float) -> None:
            bar.update(task, completed=share)

        simulate(room.scene, path, settings, folder, show, moving)
    return folder


def key_of(settings: SimulationConfig) -> str:
    """Return a text that differs for every other recording: a preset counts by its values."""
    fields = SimulationConfig.model_fields
    unchanged = {name for name in NEW_SETTINGS if getattr(settings, name) == fields[name].default}
    text = settings.model_dump_json(exclude=unchanged | {"sensor", "depth_sensor"})
    for name, stage in (("sensor", settings.sensor), ("depth_sensor", settings.depth_sensor)):
        text += "" if name in unchanged else f" {name} {json.dumps(stage.facts)}"
    return text
