"""Sequences on disk: one file per format, one dictionary of formats, one function that opens them."""

import difflib
from collections.abc import Callable
from pathlib import Path

from edslam_ti.config import Config
from edslam_ti.datasets.base import EventDepthSequence, Sample, SampledSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence, is_event_replica
from edslam_ti.datasets.rpg import RpgSequence
from edslam_ti.errors import ConfigError

__all__ = ["DATASETS", "EventDepthSequence", "Sample", "SampledSequence", "find_sequence", "open_sequence"]

# What --dataset chooses from: format -> sequence in a folder. `builtin` sequences are EventReplica's
# layout too; `open_sequence` makes them on first use.
DATASETS: dict[str, Callable[[Path, Config], EventDepthSequence]] = {
    "event_replica": lambda folder, config: EventReplicaSequence(folder, config.contrast_threshold),
    "rpg": lambda folder, config: RpgSequence(folder),
}


def find_sequence(config: Config) -> tuple[str, Path | None]:
    """Return the format and the folder of a scene; a built-in room has no folder yet.

    Without --dataset, EventReplica's recording under the data folder comes before the built-in room.
    """
    folder = _scene_folder(config)
    if config.dataset in DATASETS:
        if folder is None:
            raise _not_found(config)
        return config.dataset, folder
    if config.dataset is None and folder is not None and is_event_replica(folder):
        return "event_replica", folder
    from edslam_ti.simulation.catalogue import SCENE_NAMES

    if config.scene in SCENE_NAMES:
        return "builtin", None
    raise _not_found(config)


def open_sequence(config: Config) -> EventDepthSequence:
    """Open the scene that the settings name; without --dataset, print which one that turned out to be."""
    dataset, folder = find_sequence(config)
    if config.dataset is None:
        where = (
            f"the recording in {folder}" if folder else f"none in {config.data_dir}, so the built-in stand-in"
        )
        print(f"scene {config.scene}: {where}", flush=True)
    if folder is not None:
        return DATASETS[dataset](folder, config)
    from edslam_ti.datasets.builtin import builtin_sequence_folder
    from edslam_ti.simulation.catalogue import ROOM_NAMES

    description = f"built-in simulated room '{config.scene}', a stand-in for EventReplica's scene"
    sequence = EventReplicaSequence(
        builtin_sequence_folder(config.scene),
        config.contrast_threshold,
        description=description if config.scene in ROOM_NAMES else None,  # others describe themselves
    )
    sequence.dataset, sequence.scene = "builtin", config.scene
    return sequence


def _scene_folder(config: Config) -> Path | None:
    for parent in (config.data_dir / (config.dataset or "event_replica"), config.data_dir):
        if (parent / config.scene).is_dir():
            return parent / config.scene
    return None


def _not_found(config: Config) -> ConfigError:
    """Say what there is instead."""
    from edslam_ti.simulation.catalogue import SCENE_NAMES

    wanted = f"scene '{config.scene}' not found in {config.data_dir}"
    if config.dataset == "builtin":
        return ConfigError(f"no built-in room '{config.scene}'; there are {', '.join(SCENE_NAMES)}")
    if not config.data_dir.is_dir():
        wanted += " (there is no such folder)"
    elif is_event_replica(config.data_dir) or (config.data_dir / "events.txt").is_file():
        name = config.data_dir.resolve()
        return ConfigError(
            f"{wanted}, which is itself a sequence; use --data-dir {name.parent} --scene {name.name}"
        )
    folder = _scene_folder(config)
    if config.dataset is None and folder is not None:
        hint = "; it looks like --dataset rpg" if (folder / "events.txt").is_file() else ""
        return ConfigError(f"{folder}: no event_threshold_<C> folder as in EventReplica's layout{hint}")
    there = _scenes_in(config)
    choices = there + ([] if config.dataset else list(SCENE_NAMES))
    close = difflib.get_close_matches(config.scene, choices, n=1)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    found = f"sequences there: {', '.join(there) or 'none'}"
    builtin = "" if config.dataset else f"; built-in rooms: {', '.join(SCENE_NAMES)}"
    return ConfigError(f"{wanted}{hint}; {found}{builtin}")


def _scenes_in(config: Config) -> list[str]:
    """Return the names of the folders that hold a sequence of the wanted format."""
    names = set()
    for parent in (config.data_dir / (config.dataset or "event_replica"), config.data_dir):
        for folder in parent.iterdir() if parent.is_dir() else []:
            wanted = (
                (folder / "events.txt").is_file() if config.dataset == "rpg" else is_event_replica(folder)
            )
            if folder.is_dir() and wanted:
                names.add(folder.name)
    return sorted(names)
