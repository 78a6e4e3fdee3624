"""The command `edslam simulate`: records a built-in room or a mesh along a camera path."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edslam_ti import kernels
from edslam_ti.errors import ConfigError
from edslam_ti.output import check_replaceable
from edslam_ti.simulation.catalogue import make_room
from edslam_ti.simulation.mesh import load_mesh
from edslam_ti.simulation.moving import moving_object
from edslam_ti.simulation.paths import CameraPath, RecordedPath, look_at, make_path
from edslam_ti.simulation.recording import RecordingSummary, simulate, why_not_a_recording
from edslam_ti.simulation.settings import SimulationConfig
from edslam_ti.trajectory import read_tum

MAX_THREADS = 256
MAX_METRES = 1e6  # positions; float32 holds them to 6 cm there
SCALES = (1e-6, 1e6)  # factors from a mesh's or a path's unit to metres
MAX_START = 1e6  # seconds
UP_AXES = {
    "x": (1.0, 0, 0),
    "-x": (-1.0, 0, 0),
    "y": (0, 1.0, 0),
    "-y": (0, -1.0, 0),
    "z": (0, 0, 1.0),
    "-z": (0, 0, -1.0),
}


@dataclass(frozen=True)
class Placement:
    """Placement of a recorded trajectory in a scene; without a position it keeps its own coordinates."""

    position: tuple[float, float, float] | None = None  # metres, of the first camera
    target: tuple[float, float, float] | None = None  # metres, looked at by the first camera
    up: str = "z"  # the scene's axis that points up
    scale: float = 1.0  # factor on the motion
    start: float = 0.0  # seconds skipped

    def __post_init__(self) -> None:
        """Raise `ConfigError` for values that cannot be used, NaN among them."""
        check_setting("trajectory_scale", self.scale, *SCALES)
        check_setting("trajectory_start", self.start, 0, MAX_START)
        for name, point in (("position", self.position), ("look_at", self.target)):
            for value in point or ():
                check_setting(name, value, -MAX_METRES, MAX_METRES)

    def first_pose(self) -> np.ndarray | None:  # [4, 4]
        """Return the first pose; None: keep the trajectory's own."""
        if (self.position is None) != (self.target is None):
            raise ConfigError("position and look-at: expected both or neither; give the missing one")
        if self.position is None or self.target is None:
            return None
        return look_at(np.array(self.position), np.array(self.target), np.array(UP_AXES[self.up]))


def check_setting(name: str, value: float, least: float, most: float) -> None:
    """Raise `ConfigError` unless a number lies between two bounds, in the words of the other settings."""
    if not np.isfinite(value):
        raise ConfigError(f"{name}: Input should be a finite number, got {value!r}")
    if value < least:
        raise ConfigError(f"{name}: Input should be greater than or equal to {least:g}, got {value!r}")
    if value > most:
        raise ConfigError(f"{name}: Input should be less than or equal to {most:g}, got {value!r}")


def record(
    scene_name: str | None,
    mesh: Path | None,
    mesh_scale: float,
    trajectory: Path | None,
    placement: Placement,
    config: SimulationConfig,
    out: Path,
    threads: int = 2,
    progress: Callable[[float], None] | None = None,
) -> RecordingSummary:
    """Start Taichi on the CPU, build the scene and the path, and write the recording."""
    if (scene_name is None) == (mesh is None):
        raise ConfigError("expected either a built-in scene or a mesh; give --scene NAME or --mesh FILE")
    if mesh is not None and trajectory is None:
        raise ConfigError("mesh: expected a camera path; give --trajectory FILE (TUM format)")
    check_setting("threads", threads, 1, MAX_THREADS)
    check_setting("mesh_scale", mesh_scale, *SCALES)
    check_replaceable(out, why_not_a_recording)
    kernels.init("cpu", threads=threads)
    path: CameraPath
    if trajectory is not None:
        recorded = read_tum(trajectory)
        path = RecordedPath(recorded, placement.scale, placement.first_pose(), placement.start)
    if mesh is not None:
        scene = load_mesh(mesh, mesh_scale)
    else:
        room = make_room(scene_name or "")
        scene = room.scene
        if trajectory is None:
            path = make_path(room, config)
    moving = None
    if config.moving_object:
        if scene_name is None:
            raise ConfigError("moving_object: expected a built-in scene, got a mesh; leave it out")
        moving = moving_object(room, path)
    return simulate(scene, path, config, out, progress, moving)
