"""A page for the browser that follows a run.

The run's own thread copies what is due, a second thread turns it into messages, and viser's sends them.
Nothing is copied while no page is open, and with one open a few percent of the time is spent.
"""

import queue
import threading
import time
from collections.abc import Callable
from typing import Any

from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.viewer.live_page import LivePage, Update
from edslam_ti.viewer.moment import Moment, Say
from edslam_ti.viewer.pictures import brightness_picture, depth_picture, event_picture, grey_picture
from edslam_ti.viewer.server import load_viser, open_server
from edslam_ti.viewer.shapes import keyframe_indices
from edslam_ti.viewer.splats import SplatStream
from edslam_ti.viewer.throttle import Throttle

SHARE, ALLOWANCE = 0.04, 0.4  # of the processor's time, and seconds at first, for an open page
OFTEN = 0.1  # seconds between two updates at least
MOST_POINTS = 50_000  # of a map without Gaussians
CHECK = 0.05  # seconds between looks at the buttons while paused


class BrowserViewer:
    """A page that shows a run while it goes on (Viewer)."""

    def __init__(self, address: str, port: int, say: Say) -> None:
        """Serve the page, or raise EdSlamError where that is impossible."""
        self._server = open_server(address, port, say)
        self._stream = SplatStream(self._server.scene)
        self._page = LivePage(self._server, load_viser(), self._stream)
        self._throttle = Throttle(SHARE, ALLOWANCE)
        self._updates: queue.Queue[Update | None] = queue.Queue(maxsize=2)
        self._thread = threading.Thread(target=self._send, name="viewer", daemon=True)
        self._thread.start()
        self._last, self._turn = 0.0, 0
        self._has_truth = False
        self._problem: Exception | None = None

        @self._server.on_client_connect
        def _(client: Any) -> None:
            self._throttle.restart()
            self._has_truth = False

    @property
    def port(self) -> int:
        """The port of the page."""
        return int(self._server.get_port())

    def update(self, moment: Moment) -> None:
        """Copy what is due; a second thread sends it."""
        if self._problem is not None:
            raise self._problem
        self._page.note_numbers(moment)
        now = time.perf_counter()
        is_soon = now - self._last < OFTEN and moment.sample is None
        if is_soon or not self._server.get_clients() or self._updates.full() or not self._throttle.is_due:
            return
        self._last = now
        with self._throttle.counted():
            self._updates.put(self._copied(moment))

    def wait(self, is_ended: Callable[[], bool]) -> None:
        """Return when the run may go on."""
        while self._page.is_held() and not is_ended() and self._server.get_clients():
            time.sleep(CHECK)

    def close(self) -> None:
        """Say that the run has ended, and stop serving."""
        self._updates.put(None)
        self._thread.join(timeout=5)
        self._server.stop()

    # --- the run's thread ---

    def _copied(self, moment: Moment) -> Update:
        trajectory = moment.trajectory
        update = Update(
            poses=trajectory.poses.copy(),
            camera=moment.camera,
            keyframes=keyframe_indices(moment.mapper, len(trajectory)),
            curves=self._page.newest_curves(),
            text=self._page.status(moment),
        )
        if moment.truth is not None and not self._has_truth:
            update.truth = moment.truth.poses.copy()
            self._has_truth = True
        self._copy_pictures(moment, update)
        self._copy_map(moment, update)
        return update

    def _copy_pictures(self, moment: Moment, update: Update) -> None:
        sample, mapper = moment.sample, moment.mapper
        if sample is not None:
            update.pictures["events"] = event_picture(sample.events, moment.camera.shape)
            if sample.depth is not None:
                update.pictures["depth"] = depth_picture(sample.depth)
            if (log_brightness := moment.log_brightness()) is not None:
                update.pictures["brightness"] = brightness_picture(log_brightness)
        self._turn += 1
        if mapper is not None and mapper.num_gaussians and self._turn % 2:
            view = mapper.render(moment.camera, moment.trajectory.pose(-1))
            update.pictures["render"] = grey_picture(view.intensity)

    def _copy_map(self, moment: Moment, update: Update) -> None:
        """Copy blocks of splats as long as there is time, at least one; or points of another map."""
        mapper = moment.mapper
        if mapper is None:
            return
        gaussians = getattr(mapper, "map", None)
        if not isinstance(gaussians, GaussianMap):
            points, brightness = mapper.points()
            step = max(1, -(-len(points) // MOST_POINTS))
            update.points = points[::step].copy(), brightness[::step].copy()
            return
        while (block := self._stream.copied(gaussians)) is not None:
            update.blocks.append(block)
            if len(update.blocks) >= self._stream.num_blocks or not self._throttle.is_due:
                return

    # --- the second thread ---

    def _send(self) -> None:
        while (update := self._updates.get()) is not None:
            if self._problem is None:
                try:
                    with self._throttle.counted_in_background():
                        self._page.show(update)
                except Exception as error:  # told by the run's thread
                    self._problem = error
        self._page.end()
