"""A run whose samples come from a session: its method, folder, journal, refinement and results."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from edslam_ti.config import Config
from edslam_ti.errors import ConfigError, DataError, plain
from edslam_ti.event_images.own_sensor import own_sensor
from edslam_ti.feeding.cutter import Cut
from edslam_ti.feeding.inlet import is_pose
from edslam_ti.feeding.sequence import FedSamples, FedSequence
from edslam_ti.frame import FrameBuilder
from edslam_ti.frame_loop import is_held_out, process_sample
from edslam_ti.interruption import Interruption
from edslam_ti.journal import JOURNAL, Journal
from edslam_ti.methods import METHODS
from edslam_ti.results.folder import save
from edslam_ti.results.run import Run
from edslam_ti.results.run_folder import (
    FAILED,
    FED,
    INTERRUPTED,
    RUNNING,
    SETTINGS,
    RunFolder,
    point_latest_to,
)
from edslam_ti.slam import Slam
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.trajectory import Trajectory

RECORDINGS_ALONE: dict[str, tuple[Any, str]] = {  # settings, their neutral value, and what to do instead
    "start": (0.0, "feed it the part that it is to use"),
    "duration": (None, "feed it the part that it is to use"),
    "calibrate": ("none", "correct the data before you feed them"),
    "depth_dir": (None, "feed it the depth images"),
    "crop": (False, "feed it the part that it is to use"),
    "poses": ("tracked", "it has no true poses; leave it out"),
}


@dataclass(frozen=True)
class SessionResults:
    """What a session has found."""

    trajectory: Trajectory  # seconds of the session's clock, T_world_camera
    folder: Path | None  # results in the layout of `edslam slam`; None: not asked for
    metrics: dict[str, Any]  # of metrics.json; empty without a folder
    notes: tuple[str, ...]  # what was left out or repaired, a line each


def check_config(config: Config) -> None:
    """Raise ConfigError where settings need a recording, or its truth."""
    config.require_device()
    if config.method not in METHODS:
        raise ConfigError(f"method: expected one of {', '.join(METHODS)}, got '{plain(config.method)}'")
    if METHODS[config.method].overrides.get("poses") == "truth":
        raise ConfigError(
            f"method: {config.method} maps with true poses, and a session has none; use --method ed_slam"
        )
    for name, (neutral, advice) in RECORDINGS_ALONE.items():
        if getattr(config, name) != neutral:
            raise ConfigError(f"{name}: a session takes no {name}, got {getattr(config, name)}: {advice}")
    if config.mapping.frames:
        raise ConfigError("mapping.frames: needs a recording with grey images; leave it out for a session")


class FedRun:
    """Processes the samples that a session cuts, and keeps what results need."""

    def __init__(
        self,
        sequence: FedSequence,
        config: Config,
        initial_pose: np.ndarray | None,  # [4, 4] T_world_camera of the first frame; None: the identity
        out: Path | None,  # folder that receives the results; None: none are written
        console: Console,
        interruption: Interruption,
    ) -> None:
        self._sequence, self._config = sequence, config
        if initial_pose is not None and not is_pose(initial_pose):
            raise DataError("initial_pose: expected a 4x4 matrix, camera to world")
        self._initial_pose = np.eye(4) if initial_pose is None else np.array(initial_pose, np.float64)
        self._out, self._console, self._interruption = out, console, interruption
        self.run: Run | None = None  # None: nothing has been processed
        self.num_not_mapped = 0  # frames that were tracked alone
        self._samples = FedSamples(2 * config.evaluation.max_images)
        self._folder: RunFolder | None = None
        self._journal: Journal | None = None

    def begin(self, start: float, end: float, time_offset: float, on_tracked: Callable[[], None]) -> Run:
        """Build the method from what the sequence has gathered from `start` to `end` (seconds)."""
        sequence, config = self._sequence, self._config
        contrast, sensor = own_sensor(config.contrast_threshold, config.dead_time, sequence, start, end)
        tracker, mapper = METHODS[config.method].build(sequence, contrast, config)
        sequence.forget()
        sequence.time_offset = time_offset
        slam = Slam(
            FrameBuilder(sequence.camera, contrast.dead_time),
            tracker,
            mapper if config.mapping.enabled else None,
            self._initial_pose,
        )
        slam.on_tracked = on_tracked
        run = Run(config, sequence, self._samples, slam, set(), contrast, sensor)
        run.note(f"{sequence.scene}: {sequence.description}, method {config.method}")
        for text in contrast.notes:
            sequence.note(text)
        if config.contrast_threshold is None:
            source = "from the first images" if contrast.source == "images" else "by default"
            sequence.note(f"contrast threshold {contrast.value:.3g} {source}: the settings state none")
        if self._out is not None:
            self._folder = RunFolder.make(self._out / sequence.dataset / sequence.scene / config.method)
            self._folder.identity = {FED: True}  # its data cannot be read again
            self._folder.write(SETTINGS, config.to_yaml())
            self._folder.set_state(RUNNING)
            self._journal = Journal(self._folder.path / JOURNAL, time_offset)
        self.run = run
        return run

    def process(self, cut: Cut, is_mapped: bool = True) -> TrackingResult:
        """Track a sample and map it; `is_mapped`: False where there is no time for the map."""
        assert self.run is not None, "begin first"
        run, sample, k = self.run, cut.sample, len(self._samples)
        measures = False
        if cut.depth_number is not None:
            measures = is_held_out(cut.depth_number, self._config.evaluation.hold_out_every)
        if measures or not is_mapped:
            run.held_out.add(k)
        if not is_mapped and not measures and run.slam.mapper is not None:
            self.num_not_mapped += 1
        self._samples.add(sample, measures or not is_mapped)
        problem = "" if sample.depth is not None or cut.depth_number is None else "its depth cannot be used"
        if problem:
            run.note(f"frame {k} at {sample.timestamp:.3f} s: {problem}")
        return process_sample(run, sample, self._journal, problem)

    @property
    def is_empty(self) -> bool:
        """Whether no frame has been tracked; a folder that was made is removed then."""
        if self.run is not None and len(self.run.slam.trajectory) > 0:
            return False
        if self._folder is not None:
            self._folder.discard()
        return True

    def refine(self, progress: Callable[[float], bool]) -> None:
        """Refine the map over all that is kept."""
        assert self.run is not None, "begin first"
        run, started = self.run, time.perf_counter()
        if run.slam.mapper is not None and not run.is_refined:
            run.slam.mapper.finish(run.slam.trajectory, progress)
            run.finish_seconds += time.perf_counter() - started
            run.is_refined = not self._interruption.requested

    def save(self, notes: list[str], metrics: dict[str, Any], is_broken_off: bool) -> SessionResults:
        """Write the results, where they are asked for, and return them; `is_broken_off`: by a failure."""
        assert self.run is not None, "begin first"
        run, sequence = self.run, self._sequence
        run.held_out = self._samples.held_out
        run.live_metrics = metrics
        run.is_interrupted = self._interruption.requested or is_broken_off
        for line in notes:
            sequence.note(line)
        written: dict[str, Any] = {}
        path = None
        if self._folder is not None and self._journal is not None:
            path = self._folder.path
            try:
                self._journal.close(run.slam.trajectory)
                written = save(run, path, self._console, self._interruption) or {}
                problem = point_latest_to(path)
                if problem:
                    sequence.note(problem)
                if run.is_interrupted:
                    self._folder.set_state(FAILED if is_broken_off else INTERRUPTED)
                else:
                    self._folder.finish()
            finally:
                self._folder.close()
        return SessionResults(run.slam.trajectory.snapshot(), path, written, tuple(sequence.notes))
