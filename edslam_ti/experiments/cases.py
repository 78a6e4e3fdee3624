"""The cases of the tracking benchmark: a recording, and its alterations while it is read."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from edslam_ti.sensor_config import (
    DEPTH_PRESETS,
    DepthSensorConfig,
    DepthSensorName,
    SensorConfig,
    SensorName,
)
from edslam_ti.simulation import ROOM_NAMES, SimulationConfig
from edslam_ti.simulation.catalogue import UNSEEN_ROOM_NAMES

DURATION = 2.5  # seconds
LONG_DURATION = 30.0  # seconds, about 10 m
QUICK_DURATION = 1.2  # seconds
GAP = (1.0, 0.5)  # start and length in seconds
POSE_RATE = 200.0  # true poses per second, so that poses between depth images are evaluated, too
MEASURED = "measured"  # depth of real data
RECORDED = "recorded"  # a path that is not simulated
MESH_SCENE, REAL_SCENE = "viking_room", "slider_depth"  # of the data folder


@dataclass(frozen=True)
class Recording:
    """A recording that is simulated once, or read from the data folder: exact depth at 20 Hz."""

    scene: str
    path: str = "hand_held"
    speed: float = 1.0
    seed: int = 0
    duration: float = DURATION
    sensor: SensorName = "ideal"
    depth_sensor: DepthSensorName = "exact"

    @property
    def settings(self) -> SimulationConfig:
        """The simulation's settings; a recorded path is not one of the room's paths."""
        return SimulationConfig(
            path="hand_held" if self.path == RECORDED else self.path,
            speed=self.speed,
            seed=self.seed,
            duration=self.duration,
            pose_rate=POSE_RATE,
            compact_events=True,
            sensor=SensorConfig(preset=self.sensor),
            depth_sensor=DepthSensorConfig(preset=self.depth_sensor),
        )


@dataclass(frozen=True)
class Case:
    """One test case: one seed of a line of results."""

    group: str  # aspect that it tests
    recording: Recording
    depth: str = "exact"  # or kinect, measured, or the depth sensor's name
    rate: float = 20.0  # depth images per second
    event_gap: tuple[float, float] | None = None
    depth_gap: tuple[float, float] | None = None

    @property
    def row(self) -> str:
        """Readable name of the row, the same for all seeds."""
        recording = self.recording
        words = [recording.scene]
        if recording.path != "hand_held":
            words.append(recording.path)
        if recording.duration >= LONG_DURATION:
            words.append(f"{recording.duration:g}s")
        if recording.speed != 1:
            words.append(f"x{recording.speed:g}")
        if recording.sensor != "ideal":
            words.append(recording.sensor)
        if self.event_gap:
            words.append("event_gap")
        if self.depth_gap:
            words.append("depth_gap")
        return "-".join([*words, self.depth, f"{self.rate:g}hz"])

    @property
    def name(self) -> str:
        """Name of the case, also used as a folder name."""
        return f"{self.row}-seed{self.recording.seed}"


def all_cases(seeds: Sequence[int] = (0, 1, 2)) -> list[Case]:
    """Return all cases; those of one recording are consecutive."""
    cases = []
    for seed in seeds:
        for scene in ROOM_NAMES:
            for speed in (1.0, 2.0):
                recording = Recording(scene, speed=speed, seed=seed)
                cases += _depths("rooms", recording, rates=(20.0, 10.0, 5.0))
        for scene in UNSEEN_ROOM_NAMES:
            cases += _depths("unseen", Recording(scene, seed=seed), rates=(20.0, 5.0))
        cases += _depths("wall", Recording("wall", seed=seed), rates=(20.0, 5.0))
        cases += _depths("corridor", Recording("corridor", seed=seed))
        cases += _depths("rotation", Recording("office0", path="rotation", seed=seed))
        cases += _depths("stop_and_go", Recording("office2", path="stop_and_go", seed=seed))
        cases += _depths("mesh", Recording(MESH_SCENE, path=RECORDED, seed=seed))
        for scene in ("office3", "room0"):
            recording = Recording(scene, seed=seed)
            cases.append(Case("gaps", recording, "kinect", event_gap=GAP))
            cases.append(Case("gaps", recording, "kinect", depth_gap=GAP))
        for scene, path in (("office0", "loop"), ("room2", "hand_held")):
            cases.append(Case("long", Recording(scene, path, seed=seed, duration=LONG_DURATION), "kinect"))
    cases.append(Case("real", Recording(REAL_SCENE, path=RECORDED), MEASURED))
    cases.sort(key=lambda case: (case.recording.seed, _order(case)))
    recordings = list(dict.fromkeys(case.recording for case in cases))
    return sorted(cases, key=lambda case: recordings.index(case.recording))


def with_sensors(cases: Sequence[Case], sensor: SensorName, depth_sensor: DepthSensorName) -> list[Case]:
    """Return the cases as other sensors record them; recorded data stay as they are.

    A depth sensor other than exact takes the place of all kinds and rates of depth.
    """
    result = []
    for case in cases:
        recording = case.recording
        if recording.scene != REAL_SCENE:
            recording = replace(recording, sensor=sensor, depth_sensor=depth_sensor)
            case = replace(case, recording=recording)
            if depth_sensor != "exact":
                rate = DEPTH_PRESETS[depth_sensor].rate or recording.settings.depth_rate
                case = replace(case, depth=depth_sensor, rate=rate)
        result.append(case)
    return list(dict.fromkeys(result))


def quick_cases() -> list[Case]:
    """Return a few short cases that take about three minutes in all."""
    cases = []
    for group, scene in (("rooms", "office0"), ("wall", "wall")):
        recording = Recording(scene, duration=QUICK_DURATION)
        cases += [Case(group, recording, "kinect", rate) for rate in (20.0, 5.0)]
    return cases


def _depths(group: str, recording: Recording, rates: tuple[float, ...] = (20.0,)) -> list[Case]:
    return [Case(group, recording, depth, rate) for depth in ("exact", "kinect") for rate in rates]


def _order(case: Case) -> int:
    """Return the sort key that puts long and special recordings after the rooms."""
    groups = (
        "rooms",
        "wall",
        "corridor",
        "rotation",
        "stop_and_go",
        "unseen",
        "gaps",
        "mesh",
        "real",
        "long",
    )
    return groups.index(case.group)
