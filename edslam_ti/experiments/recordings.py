"""Recordings of the tracking benchmark: simulated on first use, or found in the data folder."""

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from edslam_ti.cache import cached
from edslam_ti.datasets import EventDepthSequence
from edslam_ti.datasets.builtin import builtin_sequence_folder, key_of
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.datasets.rpg import RpgSequence
from edslam_ti.experiments.cases import MESH_SCENE, REAL_SCENE, Recording
from edslam_ti.simulation import RecordedPath, load_mesh, look_at, simulate
from edslam_ti.trajectory import read_tum

# Scale of the mesh to metres, and placement in it of a real hand-held path (hdr_normal, faster towards its
# end).
MESH_SCALE, MESH_FILE = 4.0, Path("scenes") / MESH_SCENE / f"{MESH_SCENE}.obj"
MESH_POSITION, MESH_TARGET = np.array([1.6, 1.6, 1.6]), np.array([-0.5, -0.5, 0.8])
PATH_FILE, PATH_STARTS, PATH_SCALE = Path("trajectories") / "hdr_normal.txt", (45.0, 35.0, 52.0), 4.0

Progress = Callable[[float], None]


class Recordings:
    """Opens recordings, and records which ones it has made."""

    def __init__(self, data_dir: Path) -> None:
        """`data_dir` contains the data that is not simulated: meshes, trajectories, real sequences."""
        self._data_dir = data_dir
        self._made: dict[Recording, Path] = {}

    def open(self, recording: Recording, progress: Progress) -> EventDepthSequence:
        """Return a recording, simulating it if it does not exist yet; Taichi must have been started."""
        if recording.scene == REAL_SCENE:
            return RpgSequence(self._found(Path(REAL_SCENE)))
        is_mesh = recording.scene == MESH_SCENE
        started: list[bool] = []

        def report(share: float) -> None:
            started.append(True)
            progress(share)

        folder = (
            self._mesh_recording(recording, report)
            if is_mesh
            else builtin_sequence_folder(recording.scene, recording.settings, report)
        )
        if started:
            self._made[recording] = folder
        return EventReplicaSequence(folder)

    def discard(self, recording: Recording) -> None:
        """Delete a recording that this object has made; others stay."""
        folder = self._made.pop(recording, None)
        if folder is not None:
            shutil.rmtree(folder)

    def _found(self, path: Path) -> Path:
        if not (self._data_dir / path).exists():
            raise FileNotFoundError(
                f"{self._data_dir / path}: not found; give the folder that holds it (--data-dir)"
            )
        return self._data_dir / path

    def _mesh_recording(self, recording: Recording, progress: Progress) -> Path:
        mesh, path = self._found(MESH_FILE), self._found(PATH_FILE)
        start = PATH_STARTS[recording.seed % len(PATH_STARTS)]
        settings = recording.settings
        key = f"{key_of(settings)} {start} {PATH_SCALE} {MESH_SCALE} {MESH_POSITION} {MESH_TARGET}"
        version = hashlib.sha256(key.encode()).hexdigest()[:12]
        folder = cached(Path("sequences") / version / MESH_SCENE)
        if not folder.is_dir():
            first = look_at(MESH_POSITION, MESH_TARGET, np.array([0.0, 0.0, 1.0]))
            motion = RecordedPath(read_tum(path), PATH_SCALE, first, start)
            simulate(load_mesh(mesh, MESH_SCALE), motion, settings, folder, progress)
        return folder
