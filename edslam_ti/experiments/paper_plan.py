"""The runs that the paper's tables need: one for every recording, kind of depth, seed and method."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edslam_ti.config import Config, merged
from edslam_ti.datasets import FORMATS
from edslam_ti.errors import ConfigError
from edslam_ti.experiments.jobs import BUILTIN_RATE, EXACT, KINECT, RECORDED, Job
from edslam_ti.experiments.published import ABLATION_SCENE, PAPER_SCENES, TABLE_1, TABLE_2
from edslam_ti.methods import METHODS
from edslam_ti.sensor_config import DepthSensorName, SensorName
from edslam_ti.simulation.catalogue import SCENE_NAMES

ALL = "all"
PAPER_METHOD = "ed_slam_paper"
COMPARISONS = ("table3", "table4", "runtime")  # they share their runs
ABLATIONS = {"table1": ("patch_size", tuple(TABLE_1)), "table2": ("num_patches", tuple(TABLE_2))}
TABLES = (*ABLATIONS, *COMPARISONS)


@dataclass(frozen=True)
class Wanted:
    """What the runs are chosen by; an empty tuple takes all there is."""

    scenes: tuple[str, ...] = (ALL,)  # all: the paper's; built-in rooms have the names of EventReplica's
    methods: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (0,)
    depth: tuple[str, ...] = (EXACT,)  # of built-in rooms
    rates: tuple[float, ...] = (BUILTIN_RATE,)  # of built-in rooms, Hz
    sensor: tuple[SensorName, ...] = ("ideal",)  # of built-in rooms
    depth_sensor: tuple[DepthSensorName, ...] = ("exact",)  # of built-in rooms
    datasets: tuple[str, ...] = ()  # keys of FORMATS; none: built-in rooms and what lies in the data folder
    duration: float | None = None  # seconds of each
    data_dir: Path = Path("data")
    threads: int = 2
    device: str = "cpu"
    differences: str = "{}"  # settings for every run, as JSON


def plan(wanted: Wanted, tables: Sequence[str]) -> dict[str, list[Job]]:
    """Return the jobs of each table; tables share jobs.

    Raises ConfigError for an unknown method or data set, and for a scene that is nowhere.
    """
    _check(wanted)
    jobs: dict[str, list[Job]] = {}
    for table in tables:
        if table in ABLATIONS:
            setting, values = ABLATIONS[table]
            scenes = (ABLATION_SCENE,) if wanted.scenes == (ALL,) else wanted.scenes
            jobs[table] = [
                job
                for value in values
                for job in _of_scenes(wanted, scenes, (PAPER_METHOD,), changed(setting, value))
            ]
        else:
            jobs[table] = _of_scenes(wanted, wanted.scenes, wanted.methods or tuple(METHODS), {})
    return jobs


def changed(setting: str, value: int) -> dict[str, Any]:
    """Return the difference that a row of Table I or II makes; none where it is the method's default."""
    tracking = Config(method=PAPER_METHOD).updated(dict(METHODS[PAPER_METHOD].overrides)).tracking
    return {} if getattr(tracking, setting) == value else {"tracking": {setting: value}}


def recordings(wanted: Wanted, scenes: Sequence[str]) -> list[tuple[str, str]]:
    """Return data set and name of every recording with one of these names, built-in rooms first."""
    is_all = ALL in scenes
    names = [*(PAPER_SCENES if is_all else ()), *(name for name in scenes if name != ALL)]
    found = []
    if not wanted.datasets or "builtin" in wanted.datasets:
        found += [("builtin", name) for name in names if name in SCENE_NAMES]
    for name in names:
        for dataset in wanted.datasets or FORMATS:
            if dataset != "builtin" and _is_there(wanted.data_dir, dataset, name):
                found.append((dataset, name))
    found = list(dict.fromkeys(found))
    missing = [name for name in scenes if name != ALL and name not in {scene for _, scene in found}]
    if missing:
        raise ConfigError(
            f"scenes: expected all, built-in rooms ({', '.join(SCENE_NAMES)}) or recordings in "
            f"{wanted.data_dir}, found no '{missing[0]}'"
        )
    return found


def _of_scenes(
    wanted: Wanted, scenes: Sequence[str], methods: Sequence[str], differences: dict[str, Any]
) -> list[Job]:
    text = json.dumps(merged(json.loads(wanted.differences), differences), sort_keys=True)
    jobs = []
    for dataset, scene in recordings(wanted, scenes):
        for depth, rate, sensor, depth_sensor in _kinds(wanted, dataset == "builtin"):
            jobs += [
                Job(
                    dataset, scene, method, seed, depth, rate, wanted.duration, text,
                    str(wanted.data_dir.resolve()), wanted.threads, wanted.device,
                    sensor=sensor, depth_sensor=depth_sensor,
                )
                for method in methods
                for seed in wanted.seeds
            ]  # fmt: skip
    return jobs


def _kinds(wanted: Wanted, is_builtin: bool) -> list[tuple[str, float, SensorName, DepthSensorName]]:
    """Return depth, its rate, event sensor and depth sensor of every run on one recording."""
    if not is_builtin:
        return [(RECORDED, 0.0, "ideal", "exact")]  # as it is
    kinds: list[tuple[str, float, SensorName, DepthSensorName]] = []
    for sensor in wanted.sensor:
        for depth_sensor in wanted.depth_sensor:
            if depth_sensor != "exact":
                kinds.append((EXACT, BUILTIN_RATE, sensor, depth_sensor))
            else:
                kinds += [(depth, rate, sensor, "exact") for depth in wanted.depth for rate in wanted.rates]
    return kinds


def _is_there(data_dir: Path, dataset: str, scene: str) -> bool:
    """Return whether a recording of that format lies where `open_sequence` looks for it."""
    return any(
        (parent / scene).is_dir() and FORMATS[dataset].detect(parent / scene)
        for parent in (data_dir / dataset, data_dir)
    )


def _check(wanted: Wanted) -> None:
    for what, values, known in (
        ("methods", wanted.methods, tuple(METHODS)),
        ("datasets", wanted.datasets, tuple(FORMATS)),
        ("depth", wanted.depth, (EXACT, KINECT)),
    ):
        unknown = [value for value in values if value not in known]
        if unknown:
            raise ConfigError(f"{what}: expected some of {', '.join(known)}, got '{unknown[0]}'")
    for what, numbers in (
        *(("seeds", wanted.seeds), ("rates", wanted.rates)),
        *(("sensor", wanted.sensor), ("depth_sensor", wanted.depth_sensor)),
    ):
        if not numbers:
            raise ConfigError(f"{what}: expected at least one, got none")
    wrong = [rate for rate in wanted.rates if not 0 < rate <= BUILTIN_RATE]
    if wrong:
        raise ConfigError(f"rates: expected above 0 and up to {BUILTIN_RATE:g} Hz, got {wrong[0]:g}")
