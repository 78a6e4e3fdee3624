"""SLAM in a program of one's own: arrays go in as they come, poses and the map come out at any time.

    session = edslam_ti.Session(camera, config, time_unit="us", depth_unit="mm")
    session.add_events(x, y, t, p)                 # any number at a time
    session.add_depth(t, depth)
    session.pose()                                 # newest, 4x4 camera to world
    results = session.finish()

docs/live.md says which data make a frame, and what becomes of data that come late.
"""

import copy
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.errors import DataError, EdSlamError, plain
from edslam_ti.feeding.inlet import Inlet, is_pose
from edslam_ti.feeding.intake import DepthUnit, Intake, TimeUnit
from edslam_ti.feeding.run import FedRun, SessionResults, check_config
from edslam_ti.feeding.sequence import FedSequence
from edslam_ti.interruption import Interruption
from edslam_ti.kernels import runtime
from edslam_ti.kernels.time_surface import count_events
from edslam_ti.lenses import Lens
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.mapper import Mapper
from edslam_ti.mapping.rendering import View
from edslam_ti.results.run import Run
from edslam_ti.trajectory import Trajectory
from edslam_ti.viewer import Moment, NoViewer, Viewer

LOOKING_AHEAD = 0.1  # s beyond the last frame over which a pose is predicted; then it stays
MOST_AHEAD = 20_000_000  # events that wait while another thread processes; then `add_events` waits, too


class Session:
    """A run that is fed while it goes on.

    Whoever adds the data that complete a frame processes it, unless another thread is at it: `add_*` then
    returns at once. `pose` and `trajectory` never wait. `map`, `points` and `render` wait for the frame at
    work. Make a session in the thread that imports the package first; any thread may use it.
    """

    def __init__(
        self,
        camera: Camera | Lens,  # pixel centres at integers; a Lens: events and images are undistorted
        config: Config | None = None,  # as for `edslam slam`; state contrast_threshold where it is known
        *,
        time_unit: TimeUnit = "s",  # of all stamps
        depth_unit: DepthUnit = "m",
        depth_is_undistorted: bool = False,  # with a Lens
        initial_pose: np.ndarray | None = None,  # [4, 4] T_world_camera of the first frame; None: identity
        has_events: bool = True,  # False: depth alone, for methods that use no events
        reorder: float = 0.0,  # seconds by which events may come out of order
        patience: float = 5.0,  # seconds of data that one stream waits for the other
        out: Path | None = None,  # folder that receives results/<session>/...; None: nothing is written
        name: str = "session",
        dataset: str = "session",  # folder of the results, beside those of data sets
        viewer: Viewer | None = None,
        at_once: bool = True,  # False: frames wait for `process_next`
        console: Console | None = None,  # where progress and results are told; None: nowhere
        interruption: Interruption | None = None,
    ) -> None:
        """Start the kernels; raises ConfigError for settings that need a recording or its truth."""
        if not name or Path(name).name != name:
            raise DataError(f"name: expected one that a folder can have, got '{plain(name)}'")
        config = (config or Config()).updated({"scene": name, "dataset": None})
        check_config(config)
        try:
            runtime.ensure(config.device, config.threads)
        except RuntimeError as error:  # no such device
            raise EdSlamError(str(error)) from error
        place, one = np.zeros(1, np.int16), np.ones(1, np.int8)
        # The engine loads its kernels in this thread; other threads may then use them.
        count_events(place, place, one, np.zeros((1, 1, 2), np.int32), np.zeros((1, 1), np.int8))
        self.config = config
        intake = Intake(camera, time_unit, depth_unit, depth_is_undistorted)
        self.camera = intake.pinhole  # undistorted
        self.counts = intake.counts  # of what came, and what was left out
        self._inlet = Inlet(intake, config, has_events, reorder, patience)
        description = "data of a program" if dataset == "session" else "data of a live source"
        self._sequence = FedSequence(self.camera, dataset, name, description, has_events)
        self._interruption = interruption or Interruption()
        self._fed = FedRun(
            self._sequence, config, initial_pose, out, console or Console(quiet=True),
            self._interruption,
        )  # fmt: skip
        self._viewer: Viewer = viewer or NoViewer()
        self._at_once = at_once
        self._turn = threading.Lock()  # who processes frames
        self._state = threading.RLock()  # tracker and map; held while a frame is processed
        self._shown = Trajectory()  # what readers see; replaced, never changed
        self._results: SessionResults | None = None
        self.last_tracked: tuple[float, float] | None = None  # time of the newest pose, and when it was known
        self.num_merged = 0  # samples that were merged into the next one

    # --- feeding ---

    def add_events(self, x: Any, y: Any, t: Any, p: Any) -> None:
        """Add events: columns, rows, stamps and polarities (above 0: brighter), any number, any numeric type.

        Their order within a call does not matter. Arrays are copied. Raises DataError for arrays that do not
        fit together, and then takes nothing in.
        """
        self._require_open()
        self._inlet.add_events(x, y, t, p)
        self._process_ready()

    def add_depth(self, t: float, depth: Any) -> None:  # [H, W] in the depth unit
        """Add a depth image: z in the events' camera, 0 = missing; None: one was taken but is not usable."""
        self._require_open()
        self._inlet.add_depth(t, depth)
        self._process_ready()

    def add_image(self, t: float, image: Any) -> None:  # [H, W] grey or [H, W, 3] RGB
        """Add an image of the events' camera: integers from 0 to their largest value, floats from 0 to 1.

        Images measure the map, help to estimate the contrast threshold, and track in RGB-D methods.
        """
        self._require_open()
        self._inlet.add_image(t, image)
        self._process_ready()

    def flush(self, until: float | None = None) -> None:
        """State that all data before a stamp (None: the newest) have been added, and process them."""
        self._require_open()
        self._inlet.flush(until)
        self._process_ready()

    def finish(
        self,
        progress: Callable[[float], bool] | None = None,  # receives 0 to 1; returns False to stop
        metrics: dict[str, Any] | None = None,  # more for metrics.json
        is_broken_off: bool = False,  # save what there is, without what waits and without refinement
    ) -> SessionResults:
        """Process what waits, refine the map, and write the results if `out` was given; ends the session.

        Raises DataError where nothing could be tracked.
        """
        if self._results is not None:
            return self._results
        if not is_broken_off:
            self.end_data()
            self._process_ready(is_last=True)
        with self._state:
            if self._fed.is_empty:
                raise DataError(f"session: expected a depth image and events around it, got {self._received}")
            if not is_broken_off:
                self._fed.refine(self._shown_while(progress or (lambda fraction: True)))
            self._results = self._fed.save(self.notes, self._numbers() | (metrics or {}), is_broken_off)
            self._publish()
        self._viewer.close()
        return self._results

    def _shown_while(self, progress: Callable[[float], bool]) -> Callable[[float], bool]:
        """Return a `progress` that also shows the map to the viewer."""

        def report(fraction: float) -> bool:
            assert self._fed.run is not None
            self._viewer.update(Moment(self._fed.run.slam, self.camera, None))
            return progress(fraction)

        return report

    def end_data(self) -> None:
        """State that all data have been added; `finish` does so, too."""
        self._inlet.finish()

    # --- reading ---

    @property
    def time_offset(self) -> float:
        """Seconds to add to the trajectory's stamps to get those that were fed."""
        return self._inlet.intake.time_offset or 0.0

    @property
    def trajectory(self) -> Trajectory:
        """The poses so far, a copy; seconds since `time_offset`."""
        return self._shown.snapshot()

    @property
    def notes(self) -> list[str]:
        """What was left out, repaired or assumed, a line each."""
        told = self._sequence.notes
        return [*told, *(line for line in self._inlet.notes if line not in told)]

    def pose(self, t: float | None = None) -> np.ndarray | None:  # [4, 4] T_world_camera
        """Return the pose at a stamp (None: the newest that was fed); None before the first frame.

        Between frames it is interpolated (Eq. 9). After the last one it is predicted at constant velocity, up
        to 0.1 s ahead.
        """
        shown = self._shown
        if len(shown) == 0:
            return None
        seconds = self._inlet.newest if t is None else self._inlet.intake.second(t)
        latest = shown.timestamp(-1) + LOOKING_AHEAD
        return shown.at(min(max(seconds, shown.timestamp(0)), latest))

    @property
    def map(self) -> GaussianMap:
        """A copy of the Gaussians; raises DataError for a method whose map has none."""
        with self._state:
            gaussians = self._mapper.map
            if not isinstance(gaussians, GaussianMap):
                raise DataError(f"map: method {self.config.method} has no Gaussians; `points` has its map")
            return copy.deepcopy(gaussians)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the map's points [N, 3] (metres, world) and their brightness [N] in [0, 1]; copies."""
        with self._state:
            points, brightness = self._mapper.points()
            return np.array(points), np.array(brightness)

    def render(self, pose: np.ndarray, camera: Camera | None = None) -> View:  # [4, 4] T_world_camera
        """Return the map seen from a pose, by the session's own camera or another."""
        if not is_pose(pose):
            raise DataError(f"pose: expected a 4x4 matrix, camera to world, got shape {np.shape(pose)}")
        with self._state:
            return self._mapper.render(camera or self.camera, np.asarray(pose, np.float64))

    # --- frames, for a loop of one's own (at_once=False) ---

    def next_times(self) -> list[float]:
        """Return the times of all frames whose data are there, seconds of the session's clock, in order."""
        return self._inlet.next_times(is_all=True)

    def process_next(self, is_mapped: bool = True, merged: int = 1) -> bool:
        """Process the next frame, or several merged into one; return whether there was one.

        `is_mapped`: False tracks it without taking time for the map: its depth is left out there.
        """
        with self._turn:
            return self._process_one(is_mapped, merged)

    # --- inside ---

    @property
    def num_not_mapped(self) -> int:
        """Frames that were tracked alone."""
        return self._fed.num_not_mapped

    @property
    def run(self) -> Run | None:
        """What the session has produced so far, for progress; None before the first frame."""
        return self._fed.run

    @property
    def newest(self) -> float:
        """Newest stamp of all data, seconds of the session's clock."""
        return self._inlet.newest

    @property
    def _mapper(self) -> Mapper:
        run = self._fed.run
        if run is None or run.slam.mapper is None:
            why = "mapping is off" if not self.config.mapping.enabled else "there is no frame yet"
            raise DataError(f"map: {why}")
        return run.slam.mapper

    @property
    def _received(self) -> str:
        counts = self.counts
        left_out = f" ({'; '.join(counts.notes)})" if counts.notes else ""
        return f"{counts.events} events and {counts.depth_images} depth images{left_out}"

    def _require_open(self) -> None:
        if self._results is not None:
            raise DataError("session: it has been finished; make a new one for more data")

    def _process_ready(self, is_last: bool = False) -> None:
        """Process all complete frames, unless another thread does; it looks again when it is done."""
        if not self._at_once and not is_last:
            return
        while self._inlet.next_times():
            must_wait = is_last or self._inlet.num_waiting > MOST_AHEAD
            if not self._turn.acquire(blocking=must_wait):
                return
            try:
                while self._process_one(True, 1):
                    pass
            finally:
                self._turn.release()

    def _process_one(self, is_mapped: bool, merged: int) -> bool:
        if not self._inlet.next_times():
            return False
        with self._state:
            if self._fed.run is None:
                start, end = self._inlet.gather(self._sequence)
                self._fed.begin(start, end, self.time_offset, self._on_tracked)
                merged = 1
            cut = self._inlet.cut(merged)
            run = self._fed.run
            if cut is None or run is None:
                return False
            self.num_merged += cut.num_merged
            self._fed.process(cut, is_mapped)
            self._publish()
            self._viewer.update(Moment(run.slam, self.camera, cut.sample))
        self._viewer.wait(lambda: self._interruption.requested)
        return True

    def _on_tracked(self) -> None:
        self._publish()
        self.last_tracked = (self._shown.timestamp(-1), time.perf_counter())

    def _publish(self) -> None:
        """Show readers the poses as they are now."""
        run = self._fed.run
        if run is not None:
            self._shown = run.slam.trajectory.snapshot()

    def _numbers(self) -> dict[str, Any]:
        """Return what metrics.json says of the feeding."""
        counts, iterations = self.counts, self.config.mapping.iterations
        return {
            "num_late_events": counts.events_late,
            "num_late_depth_images": counts.depth_late,
            "num_frames_merged": self.num_merged,
            "num_frames_not_mapped": self.num_not_mapped,
            "num_mapping_steps_skipped": self.num_not_mapped * iterations,
        }
