"""Sequences on disk: one file per format, one dictionary of formats, functions that find and open a scene.

To add a data set:

1. Write `datasets/<name>.py` with a subclass of `EventDepthSequence` (base.py). Its constructor takes the
   folder of one scene, sets every attribute of the base class, and checks the files as far as it can without
   reading everything. files.py reads tables and images, depth.py depth, edslam_ti/event_files events.
2. Add a line to `FORMATS`: how to open a folder, how to detect it, one line about the layout.
   `--dataset <name>`, automatic detection and the lists in error messages follow from that line.
3. Write `configs/<name>.yaml` if the sensor needs settings that differ from the defaults.
4. Test the loader on small files that the test writes in the published layout, as tests/datasets do.
"""

import difflib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from edslam_ti.config import Config
from edslam_ti.datasets.base import EventDepthSequence, Sample, SampledSequence, WrappedSequence
from edslam_ti.datasets.camera_file import read_camera
from edslam_ti.datasets.dsec import DsecSequence, is_dsec
from edslam_ti.datasets.event_replica import EventReplicaSequence, is_event_replica
from edslam_ti.datasets.evslam import EvslamSequence, is_evslam
from edslam_ti.datasets.generic import GenericSequence, is_generic
from edslam_ti.datasets.m3ed import M3edSequence, is_m3ed
from edslam_ti.datasets.mvsec import MvsecSequence, is_mvsec
from edslam_ti.datasets.other_depth import OtherDepth
from edslam_ti.datasets.rgbd import RgbdSequence, is_rgbd
from edslam_ti.datasets.rpg import RpgSequence, is_rpg
from edslam_ti.datasets.tum_vie import TumVieSequence, is_tum_vie
from edslam_ti.datasets.vector import VectorSequence, is_vector
from edslam_ti.errors import ConfigError, plain
from edslam_ti.sensor_config import DepthSensorConfig, SensorConfig

__all__ = [
    "FORMATS",
    "EventDepthSequence",
    "Format",
    "Found",
    "Sample",
    "SampledSequence",
    "WrappedSequence",
    "find_sequence",
    "open_folder",
    "open_sequence",
    "preset_of",
]


@dataclass(frozen=True)
class Format:
    """A layout of a sequence's files."""

    description: str  # the layout and its distinctive files, for messages
    open: Callable[[Path, Config], EventDepthSequence]  # from the folder of one scene
    detect: Callable[[Path], bool]  # whether a folder holds such a sequence
    scenes: Callable[[], Sequence[str]] = tuple  # scenes that need no data; `make` makes them
    make: Callable[[str, Config], Path] | None = None  # returns a scene's folder, made on first use


class Found(NamedTuple):
    """Where a scene was found."""

    dataset: str  # key of FORMATS
    folder: Path | None  # None: built in, made when it is opened


def _builtin_scenes() -> Sequence[str]:
    from edslam_ti.simulation.catalogue import SCENE_NAMES

    return SCENE_NAMES


def _open_builtin(folder: Path, config: Config) -> EventDepthSequence:
    from edslam_ti.datasets.builtin import BuiltinSequence

    return BuiltinSequence(folder, config.contrast_threshold)


def _make_builtin(scene: str, config: Config) -> Path:
    from edslam_ti.datasets.builtin import builtin_sequence_folder
    from edslam_ti.simulation.settings import SimulationConfig

    return builtin_sequence_folder(
        scene, SimulationConfig(sensor=config.sensor, depth_sensor=config.depth_sensor)
    )


# The choices of --dataset. Without it, a recording in the first format takes precedence over all others, and
# any recording over a built-in room.
FORMATS: dict[str, Format] = {
    "event_replica": Format(
        "EventReplica's layout, with event_threshold_<C>/gray_events_data.npy",
        lambda folder, config: EventReplicaSequence(
            folder,
            config.contrast_threshold,
            config.depth_rate,
            config.image_rate,
            config.depth_dir is None,
        ),
        is_event_replica,
    ),
    "generic": Format(
        "generic layout, with camera.json and events.* or depth.txt",
        lambda folder, config: GenericSequence(folder),
        is_generic,
    ),
    "rpg": Format(
        "RPG Event Camera Dataset's layout, with events.txt",
        lambda folder, config: RpgSequence(folder, config.depth_dir is None),
        is_rpg,
    ),
    "vector": Format(
        "VECtor benchmark's layout, with <name>.synced.left_event.hdf5",
        lambda folder, config: VectorSequence(folder, config.crop, config.depth_dir is None),
        is_vector,
    ),
    "dsec": Format(
        "DSEC's layout, with events/left/events.h5",
        lambda folder, config: DsecSequence(folder, config.depth_dir is None),
        is_dsec,
    ),
    "tum_vie": Format(
        "TUM-VIE's layout, with <name>-events_left.h5",
        lambda folder, config: TumVieSequence(folder, config.depth_dir is None),
        is_tum_vie,
    ),
    "mvsec": Format(
        "MVSEC's layout, with <name>_data.hdf5",
        lambda folder, config: MvsecSequence(folder, config.depth_dir is None),
        is_mvsec,
    ),
    "m3ed": Format(
        "M3ED's layout, with <name>_data.h5",
        lambda folder, config: M3edSequence(folder, config.depth_dir is None),
        is_m3ed,
    ),
    "evslam": Format(
        "EvSLAM's layout, with <name>.bag and calib_results_cam.txt",
        lambda folder, config: EvslamSequence(folder, config.depth_dir is None),
        is_evslam,
    ),
    "rgbd": Format(
        "layouts of TUM RGB-D, of NICE-SLAM's Replica and of 7-Scenes, without events",
        lambda folder, config: RgbdSequence(folder),
        is_rgbd,
    ),
    "builtin": Format(
        "simulated rooms, made on first use",
        _open_builtin,
        lambda folder: False,  # their layout is EventReplica's
        _builtin_scenes,
        _make_builtin,
    ),
}


def find_sequence(config: Config) -> Found:
    """Return the format and the folder of the scene that the settings name.

    Raises `ConfigError` for an unknown data set, an unknown scene, and a folder that is in no known layout
    or in several.
    """
    if config.dataset is not None:
        return _find_in(config, config.dataset)
    for folder in _folders(config):
        names = [name for name, format in FORMATS.items() if format.detect(folder)]
        if len(names) > 1:
            raise ConfigError(f"{folder}: looks like {' and like '.join(names)}; choose one with --dataset")
        if names:
            return Found(names[0], folder)
    for name, format in FORMATS.items():
        if config.scene in format.scenes():
            return Found(name, None)
    raise _not_found(config, FORMATS)


def preset_of(config: Config) -> str:
    """Return the data set whose settings fit the scene that the settings name; raises as `find_sequence`.

    It is the scene's own, unless its camera.json states another one.
    """
    found = find_sequence(config)
    stated = found.folder / "camera.json" if found.folder is not None else None
    if found.dataset in ("event_replica", "generic") and stated is not None and stated.is_file():
        return read_camera(stated).preset or found.dataset
    return found.dataset


def open_sequence(config: Config) -> EventDepthSequence:
    """Open the scene that the settings name; a built-in one is simulated on first use (Taichi must run).

    Raises what `find_sequence` raises, and `DataError` or `FileNotFoundError` for files that cannot be used.
    """
    found = find_sequence(config)
    for key in ("depth_rate", "image_rate"):
        if getattr(config, key) is not None and found.dataset != "event_replica":
            raise ConfigError(
                f"{key}: expected with event_replica alone, got it with {found.dataset}, whose files state "
                "the times of images; leave it out"
            )
    for key, is_changed in (
        ("sensor", config.sensor != SensorConfig()),
        ("depth_sensor", config.depth_sensor != DepthSensorConfig()),
    ):
        if is_changed and found.dataset != "builtin":
            raise ConfigError(
                f"{key}: expected with built-in rooms alone, which are simulated, got it with "
                f"{found.dataset}; leave it out"
            )
    format = FORMATS[found.dataset]
    folder = found.folder
    if folder is None:
        assert format.make is not None, f"{found.dataset}: has scenes but no way to make them"
        folder = format.make(config.scene, config)
    sequence = format.open(folder, config)
    if config.crop and found.dataset != "vector":
        raise ConfigError(f"crop: expected with vector alone, got it with {found.dataset}; leave it out")
    return sequence if config.depth_dir is None else OtherDepth(sequence, config.depth_dir)


def open_folder(folder: Path, config: Config) -> EventDepthSequence:
    """Open the recording in a folder, in the layout that the settings name, else in the one it looks like.

    Raises what `open_sequence` raises.
    """
    if not folder.is_dir():
        raise ConfigError(f"{plain(folder, 400)}: expected the folder of a recording, found no such folder")
    if config.dataset is not None and config.dataset not in FORMATS:
        _find_in(config, config.dataset)  # raises, naming the nearest
    names = [name for name, format in FORMATS.items() if format.detect(folder)]
    if config.dataset is None and len(names) > 1:
        raise ConfigError(f"{folder}: looks like {' and like '.join(names)}; choose one with --dataset")
    if config.dataset is None and not names:
        known = "; ".join(f"{name} ({f.description})" for name, f in FORMATS.items() if not f.scenes())
        raise ConfigError(f"{folder}: in no known layout; expected one of {known}")
    return FORMATS[config.dataset or names[0]].open(folder, config)


def _find_in(config: Config, dataset: str) -> Found:
    if dataset not in FORMATS:
        close = difflib.get_close_matches(dataset, FORMATS, n=1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        raise ConfigError(f"dataset: expected one of {', '.join(FORMATS)}, got '{dataset}'{hint}")
    format = FORMATS[dataset]
    built_in = format.scenes()
    if config.scene in built_in:
        return Found(dataset, None)
    if built_in:
        raise ConfigError(f"no built-in room '{config.scene}'; there are {', '.join(built_in)}")
    # Any folder of that name: the loader's message says what is missing in it.
    for folder in _folders(config):
        return Found(dataset, folder)
    raise _not_found(config, {dataset: format})


def _parents(config: Config) -> list[Path]:
    """Return the folders that may hold sequences: <data_dir>/<dataset> of every data set, and data_dir."""
    names = list(FORMATS) if config.dataset is None else [config.dataset]
    return [*(config.data_dir / name for name in names), config.data_dir]


def _folders(config: Config) -> Iterator[Path]:
    """Yield the folders that carry the scene's name."""
    return (parent / config.scene for parent in _parents(config) if (parent / config.scene).is_dir())


def _not_found(config: Config, formats: dict[str, Format]) -> ConfigError:
    """Return an error that lists the sequences that exist in these formats."""
    wanted = f"scene '{config.scene}' not found in {config.data_dir}"
    if not config.data_dir.is_dir():
        wanted += " (there is no such folder)"
    elif any(format.detect(config.data_dir) for format in FORMATS.values()):
        name = config.data_dir.resolve()
        return ConfigError(
            f"{wanted}, which is itself a sequence; use --data-dir {name.parent} --scene {name.name}"
        )
    for folder in _folders(config):
        known = "; ".join(f"{name} ({f.description})" for name, f in formats.items() if not f.scenes())
        return ConfigError(f"{folder}: in no known layout; expected one of {known}")
    recorded = _recorded_scenes(config, formats)
    built_in = [scene for format in formats.values() for scene in format.scenes()]
    close = difflib.get_close_matches(config.scene, [*recorded, *built_in], n=1)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    found = f"sequences there: {', '.join(recorded) or 'none'}"
    rooms = f"; built-in rooms: {', '.join(built_in)}" if built_in else ""
    return ConfigError(f"{wanted}{hint}; {found}{rooms}")


def _recorded_scenes(config: Config, formats: dict[str, Format]) -> list[str]:
    """Return the names of the folders that hold a sequence of one of the formats."""
    folders = [f for parent in _parents(config) if parent.is_dir() for f in parent.iterdir() if f.is_dir()]
    return sorted({f.name for f in folders if any(format.detect(f) for format in formats.values())})
