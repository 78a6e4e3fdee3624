"""The loop of `edslam live`: takes in what a source hands over, and keeps up with it.

Data wait in a bounded inbox. Where frames fall behind the newest data, mapping gives way first: a frame is
tracked alone. Where that does not suffice, frames are merged: one pose for several.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

from edslam_ti.config import Config
from edslam_ti.depth_reprojection import DepthReprojection
from edslam_ti.errors import DataError, plain
from edslam_ti.feeding.run import check_config
from edslam_ti.frame_loop import speed_text, told
from edslam_ti.interruption import Interruption, Stopped, signals_handled
from edslam_ti.live.items import (
    CameraItem,
    DepthItem,
    EndItem,
    EventsItem,
    ImageItem,
    Inbox,
    Item,
    NoteItem,
    Source,
    TimeItem,
)
from edslam_ti.live.warm_up import warm_up
from edslam_ti.patient_console import progress_bar, say
from edslam_ti.session import Session
from edslam_ti.viewer import Viewer

POLL = 0.05  # seconds between two looks at signals while nothing comes
MOST_MERGED = 4  # frames that become one: 0.2 s of motion between two poses
# Settings that say which part of a recording is played.
NOT_THE_SESSION: dict[str, Any] = {"start": 0.0, "duration": None, "depth_dir": None}
MOST_LATENCIES = 200_000  # of frames, from which the median is taken: hours


@dataclass(frozen=True)
class Pressure:
    """Seconds that a frame may wait once its data are complete."""

    mapping_gives_way: float = 0.1
    frames_are_merged: float = 0.4


@dataclass
class Milestones:
    """When the data had come so far."""

    _reached: deque[tuple[float, float]] = field(default_factory=deque)  # stamp, moment; s, both increasing

    def note(self, stamp: float, moment: float) -> None:
        """Note that at a moment data up to a stamp (s) had come."""
        if not self._reached or stamp > self._reached[-1][0]:
            self._reached.append((stamp, moment))

    def moment_of(self, stamp: float) -> float | None:
        """Return the moment at which data at or after a stamp had come first; stamps must increase."""
        while self._reached and self._reached[0][0] < stamp:
            self._reached.popleft()
        return self._reached[0][1] if self._reached else None


class LiveRun:
    """A session fed by a source."""

    def __init__(
        self,
        source: Source,
        config: Config,
        console: Console,
        interruption: Interruption,
        make_session: Callable[[CameraItem], Session],
        pressure: Pressure | None,  # None: every frame is mapped, however long it takes
    ) -> None:
        self._source, self._config, self._console = source, config, console
        self._interruption, self._make_session = interruption, make_session
        self._pressure = pressure
        self._reprojection: DepthReprojection | None = None
        self._latencies: deque[float] = deque(maxlen=MOST_LATENCIES)  # seconds
        self._newest, self._complete = Milestones(), Milestones()
        self._inbox = Inbox()
        self._is_ended = False
        self.session: Session | None = None

    def run(self) -> None:
        """Feed the session until the data end or a signal comes; raises what ended the source."""
        self._inbox.fill_from(self._source)
        columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False))
        with Progress(*columns, console=self._console, transient=True) as bar:
            task = bar.add_task("waiting for data", total=None)
            try:
                while not self._interruption.requested:
                    has_frames = self.session is not None and bool(self.session.next_times())
                    # Without pressure, frames come first: what is not taken in keeps the source waiting.
                    is_first = has_frames and self._pressure is None
                    items = [] if is_first else self._inbox.take(0.0 if has_frames else POLL)
                    for item, came in items:
                        self._take_in(item, came)
                    if self._is_ended or (self._inbox.is_ended and not items and not is_first):
                        break
                    if has_frames and self.session is not None:
                        self._process(self.session)
                        bar.update(task, description=self._status(self.session))
            finally:
                self._inbox.end()
                self._source.close()
        if self._inbox.error is not None and self.session is None:
            raise self._inbox.error
        if self._inbox.error is not None:
            self._tell(f"the data ended: {plain(self._inbox.error)}")
        if self.session is not None and not self._interruption.is_urgent:
            self._pressure = None  # what waits has time now
            self.session.end_data()
            while self.session.next_times() and not self._interruption.is_urgent:
                self._process(self.session)

    def metrics(self) -> dict[str, Any]:
        """Return what metrics.json says of a live run besides the session's numbers.

        The latency of a pose counts from the arrival of the first datum at or after its time.
        """
        values = np.percentile(self._latencies, (50, 99)) if self._latencies else (None, None)
        names = ("latency_median_ms", "latency_99_ms")
        return {name: None if v is None else round(1000 * float(v), 2) for name, v in zip(names, values)}

    def _take_in(self, item: Item, came: float) -> None:
        if isinstance(item, CameraItem):
            self.session, self._reprojection = self._make_session(item), item.reprojection
        elif isinstance(item, NoteItem):
            self._tell(item.text)
        elif isinstance(item, EndItem):
            self._is_ended = True
        elif self.session is not None:
            try:
                feed(self.session, item, self._reprojection)
            except DataError as error:
                self._tell(f"left out: {plain(error)}")
            self._newest.note(self.session.newest, came)
            if times := self.session.next_times():
                self._complete.note(times[-1], came)

    def _process(self, session: Session) -> None:
        """Process the next frame, with less work the further it is behind."""
        since = self._complete.moment_of(session.next_times()[0])
        waited = 0.0 if since is None else time.perf_counter() - since
        is_mapped, merged = True, 1
        if self._pressure is not None:
            is_mapped = waited <= self._pressure.mapping_gives_way
            merged = MOST_MERGED if waited > self._pressure.frames_are_merged else 1
        if session.process_next(is_mapped, merged) and session.last_tracked is not None:
            stamp, moment = session.last_tracked
            came = self._newest.moment_of(stamp)
            if came is not None:
                self._latencies.append(moment - came)

    def _tell(self, line: str) -> None:
        say(self._console, plain(line))
        if self.session is not None and self.session.run is not None:
            self.session.run.note(line)

    def _status(self, session: Session) -> str:
        if session.run is None:
            return "tracking"
        behind = 1000 * max(0.0, session.newest - session.run.slam.trajectory.timestamp(-1))
        lost = sum(not result.converged for result in session.run.slam.results[-20:])
        text = f"{len(session.run.slam.results)} frames  {speed_text(session.run)}  {behind:.0f} ms behind"
        return text + (f"  {lost} of the last 20 lost" if lost else "")


def feed(session: Session, item: Item, reprojection: DepthReprojection | None) -> None:
    """Hand an item's data to a session; `reprojection`: depth is another camera's."""
    if isinstance(item, EventsItem):
        session.add_events(item.x, item.y, item.t, item.p)
    elif isinstance(item, DepthItem):
        depth = item.depth
        if reprojection is not None and depth is not None:
            depth = reprojection(depth)
        session.add_depth(item.t, depth)
    elif isinstance(item, ImageItem):
        session.add_image(item.t, item.image)
    elif isinstance(item, TimeItem):
        session.flush(item.t)


@dataclass(frozen=True)
class LiveSettings:
    """How a live run takes in its data."""

    name: str = "live"  # folder of the results
    patience: float = 0.25  # seconds of data that events and depth wait for each other
    reorder: float = 0.0  # seconds by which events may come out of order
    keeps_up: bool = True  # False: every frame is mapped; the source waits where it can


def run_live(
    source: Source,
    config: Config,
    settings: LiveSettings,
    console: Console,
    viewer: Viewer,
) -> Path:
    """Track what a source hands over until it ends, refine the map, and return the results folder.

    Ctrl-C ends the data: what has come is refined and saved. A second one, SIGTERM or SIGHUP saves at once;
    then `Stopped` is raised. Raises DataError where nothing could be tracked.
    """
    check_config(config.updated(NOT_THE_SESSION))
    with console.status("loading kernels"):
        warm_up(config.updated(NOT_THE_SESSION))
    say(console, f"live from {plain(source.description)}, method {config.method} on {config.device}")

    def make_session(camera: CameraItem) -> Session:
        lens = camera.file.lens
        stated = camera.file.contrast_threshold
        own = config
        if config.contrast_threshold is None and stated is not None:
            own = config.updated({"contrast_threshold": stated})
        size = f"{lens.pinhole.width}x{lens.pinhole.height}"
        say(console, f"camera {size}, results in {plain(config.out, 4096)}")
        return Session(
            lens if lens.is_distorted else lens.pinhole,
            own.updated(NOT_THE_SESSION),
            time_unit=camera.time_unit,
            depth_unit=camera.depth_unit,
            depth_is_undistorted=camera.file.depth_undistorted,
            initial_pose=camera.initial_pose,
            has_events=camera.has_events,
            reorder=settings.reorder,
            patience=settings.patience,
            out=config.out,
            name=settings.name,
            dataset="live",
            viewer=viewer,
            at_once=False,
            console=console,
            interruption=interruption,
        )

    with signals_handled() as interruption, interruption.deferred():
        pressure = Pressure() if source.is_live and settings.keeps_up else None
        live = LiveRun(source, config, console, interruption, make_session, pressure)
        failure: Exception | None = None
        try:
            live.run()
        except Stopped:
            pass  # the signal is known, and that it is urgent
        except Exception as error:
            failure = error
        session = live.session
        if session is None or session.newest == -math.inf:
            if interruption.number is not None:
                raise Stopped(interruption.number)
            raise failure or DataError(f"live: {source.description}: the data ended before there were any")
        if failure is not None and session.run is not None:
            failure = told(failure, session.run)
        if interruption.is_ctrl_c_once:
            interruption.forgive()
            say(console, "no more data: refining and saving (Ctrl-C once more saves at once)")
        with progress_bar(console, TimeRemainingColumn()) as bar:
            task = bar.add_task("refining", total=100, status="")

            def report(share: float) -> bool:
                bar.update(task, completed=int(100 * share))
                return not interruption.requested

            results = session.finish(report, live.metrics(), is_broken_off=failure is not None)
        _say_numbers(results.metrics, console)
        if results.folder is not None:
            say(console, f"results: {plain(results.folder, 4096)}")
    if failure is not None:
        raise failure
    if interruption.number is not None:
        raise Stopped(interruption.number)  # everything is saved; the exit code still says what happened
    assert results.folder is not None, "asked for above"
    return results.folder


def _say_numbers(metrics: dict[str, Any], console: Console) -> None:
    if metrics.get("latency_median_ms") is None:
        return
    say(
        console,
        f"latency {metrics['latency_median_ms']:.0f} ms in the median, 99 % below "
        f"{metrics['latency_99_ms']:.0f} ms; {metrics['num_frames_merged']} frames merged, "
        f"{metrics['num_frames_not_mapped']} not mapped "
        f"({metrics['num_mapping_steps_skipped']} mapping steps skipped)",
    )
