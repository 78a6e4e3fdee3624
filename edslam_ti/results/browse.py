"""Finished runs on a page for the browser: side by side, in time, measured and compared with the truth."""

import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.errors import plain
from edslam_ti.results.plots import colours
from edslam_ti.results.shown_run import KINDS, ShownRun, first_hit
from edslam_ti.viewer.moment import Say
from edslam_ti.viewer.server import (
    add_lines,
    add_screenshot_button,
    look_through,
    open_server,
    place_eye,
    set_up,
    words,
)
from edslam_ti.viewer.shapes import TRUTH_COLOUR, frustum_lines, path_lines

GAP = 1.15  # distance of runs side by side, in widths of what they show
FRAME_RATE = 15.0  # Hz, of the flight along the path
FRUSTUM = 0.1  # metres
MEASURED_COLOUR = "#CC79A7"


def show_in_browser(results: Sequence[Path], address: str, port: int, say: Say) -> None:
    """Show finished runs on a page until Ctrl-C."""
    runs = [ShownRun.load(folder) for folder in results]
    server = open_server(address, port, say)
    page = FinishedPage(server, runs)
    say("Ctrl-C ends it")
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        pass  # that is how it ends
    finally:
        page.close()
        server.stop()


class FinishedPage:
    """The page of finished runs."""

    def __init__(self, server: Any, runs: Sequence[ShownRun]) -> None:
        self._server, self._runs = server, runs
        self._shapes: list[dict[str, Any]] = [{} for _ in runs]  # by kind, made when first shown
        self._picked: list[np.ndarray] = []  # points that were clicked, world
        self._measured: list[Any] = []  # handles of what marks them
        self._player: threading.Thread | None = None
        self._is_playing = threading.Event()
        self._frames = [server.scene.add_frame(f"/runs/{k}", show_axes=False) for k in range(len(runs))]
        self._add_controls()
        for k, (run, colour) in enumerate(zip(runs, colours())):
            positions = run.trajectory.poses[:, :3, 3]
            if len(positions) > 1:
                add_lines(server, f"/runs/{k}/path", path_lines(positions), colour, 3.0)
            if run.truth is not None and len(run.truth) > 1:
                truth = path_lines(run.truth.poses[:, :3, 3])
                add_lines(server, f"/runs/{k}/truth", truth, TRUTH_COLOUR, 1.5)
        self._arrange()
        self._show_kind()
        self._show_time()
        self._show_comparison()

    def close(self) -> None:
        """End the flight."""
        self._is_playing.clear()

    def _add_controls(self) -> None:
        gui, runs = self._server.gui, self._runs
        gui.add_html(words(*(f"{k + 1}: {plain(run.title, 200)}" for k, run in enumerate(runs))))
        kinds = [kind for kind in KINDS if any(run.has(kind) for run in runs)] or ["none"]
        self._kind = gui.add_dropdown("Show", kinds, initial_value=kinds[0])
        self._kind.on_update(lambda event: self._show_kind())
        self._beside = gui.add_checkbox("Side by side", len(runs) > 1, visible=len(runs) > 1)
        self._beside.on_update(lambda event: self._arrange())
        with gui.add_folder("Time"):
            end = max(max(run.duration for run in runs), 1e-3)
            self._time = gui.add_slider("seconds", 0.0, end, end / 1000, 0.0)
            self._fly = gui.add_checkbox("Fly with the camera", False)
            self._play = gui.add_button("Play")
        self._time.on_update(lambda event: self._show_time())
        self._fly.on_update(lambda event: self._show_time())
        self._play.on_click(lambda event: self._toggle_play())
        with gui.add_folder("Measure"):
            self._measure = gui.add_checkbox("Distance between two clicks", False)
            self._distance = gui.add_html("")
        self._measure.on_update(lambda event: self._begin_measuring())
        self._add_comparison()
        add_screenshot_button(self._server)

    # --- the scene ---

    @property
    def shifts(self) -> list[np.ndarray]:  # [3] metres each
        """Where the runs stand."""
        if not self._beside.value:
            return [np.zeros(3)] * len(self._runs)
        right = self._runs[0].trajectory.pose(0)[:3, 0]
        width = GAP * max(run.width(right) for run in self._runs)
        return [k * width * right for k in range(len(self._runs))]

    def _arrange(self) -> None:
        """Place the runs, and let new pages open with all of their paths in sight."""
        poses = []
        for frame, run, shift in zip(self._frames, self._runs, self.shifts):
            frame.position = tuple(shift)
            moved = run.trajectory.poses.copy()
            moved[:, :3, 3] += shift
            poses.append(moved)
        set_up(self._server, poses[0])
        place_eye(self._server, np.concatenate(poses), self._runs[0].half_height)

    def _show_kind(self) -> None:
        """Show splats, meshes or points; a run that lacks them shows what it has."""
        for k, (run, shapes) in enumerate(zip(self._runs, self._shapes)):
            kind = self._kind.value if run.has(self._kind.value) else run.best
            if kind is not None and kind not in shapes:
                shapes[kind] = run.draw(kind, self._server.scene, f"/runs/{k}/{kind}")
            for name, handle in shapes.items():
                handle.visible = name == kind

    # --- time ---

    def _show_time(self) -> None:
        """Show the cameras at the time of the slider; fly there."""
        for k, (run, colour) in enumerate(zip(self._runs, colours())):
            T = run.pose_at(self._time.value)
            lines = frustum_lines(T, run.camera, FRUSTUM)
            marker = add_lines(self._server, f"/runs/{k}/camera", lines, colour, 3.0)
            marker.visible = not (self._fly.value and k == 0)  # it would be around the eye
        if self._fly.value:
            T = self._runs[0].pose_at(self._time.value)
            for client in self._server.get_clients().values():
                look_through(client, T, 2 * float(np.arctan(self._runs[0].half_height)))

    def _toggle_play(self) -> None:
        if self._is_playing.is_set():
            self._is_playing.clear()
            return
        self._is_playing.set()
        self._play.label = "Stop"
        threading.Thread(target=self._play_on, name="player", daemon=True).start()

    def _play_on(self) -> None:
        """Move the slider on until the end, at the pace of the recording."""
        begin = self._time.value if self._time.value < self._time.max else 0.0
        started = time.perf_counter()
        while self._is_playing.is_set():
            now = min(begin + time.perf_counter() - started, self._time.max)
            self._time.value = now
            self._show_time()
            if now >= self._time.max:
                self._is_playing.clear()
            time.sleep(1 / FRAME_RATE)
        self._play.label = "Play"

    # --- distances ---

    def _begin_measuring(self) -> None:
        self._forget_measured()
        if not self._measure.value:
            self._server.scene.remove_click_callback()
            self._distance.content = ""
            return
        self._distance.content = words("click two points of the map")
        self._server.scene.on_click()(lambda event: self.pick(event.ray_origin, event.ray_direction))

    def _forget_measured(self) -> None:
        for handle in self._measured:
            handle.remove()
        self._measured, self._picked = [], []

    def pick(self, origin: Sequence[float], direction: Sequence[float]) -> None:
        """Take the point that a click hit; the second one gives the distance."""
        if len(self._picked) == 2:
            self._forget_measured()
        hits = [
            first_hit(run.points + shift, np.array(origin), np.array(direction))
            for run, shift in zip(self._runs, self.shifts)
        ]
        known = [hit for hit in hits if hit is not None]
        if not known:
            self._distance.content = words("there is no point of the map; click again")
            return
        point = min(known, key=lambda hit: float(np.linalg.norm(hit - origin)))
        self._picked.append(point)
        name, scene = f"/measured/{len(self._picked)}", self._server.scene
        colour = (204, 121, 167)
        self._measured.append(scene.add_icosphere(name, 0.012, color=colour, position=tuple(point)))
        self._distance.content = words("one point; click another")
        if len(self._picked) == 2:
            first, second = self._picked
            text = f"{np.linalg.norm(second - first):.3f} m"
            self._measured.append(
                add_lines(self._server, "/measured/line", [np.stack([first, second])], MEASURED_COLOUR, 3.0)
            )
            place = tuple((first + second) / 2)
            self._measured.append(scene.add_label("/measured/label", text, position=place))
            self._distance.content = words(text)

    # --- render and truth ---

    def _add_comparison(self) -> None:
        self._views = {
            f"{k + 1}: {stamp:.3f} s": (run, stamp)
            for k, run in enumerate(self._runs)
            for stamp in run.held_out
        }
        names = list(self._views)
        with self._server.gui.add_folder("Times that mapping did not see", visible=bool(names)):
            self._view = self._server.gui.add_dropdown("time", names or ["none"])
            blank = np.full((60, 96, 3), 235, np.uint8)
            self._pictures = [
                self._server.gui.add_image(blank, label=name, format="jpeg") for name in ("truth", "render")
            ]
        self._view.on_update(lambda event: self._choose_view())

    def _choose_view(self) -> None:
        run, stamp = self._views[self._view.value]
        self._time.value = float(np.clip(stamp - run.begin, 0, self._time.max))
        self._show_comparison()
        self._show_time()

    def _show_comparison(self) -> None:
        if self._views:
            run, stamp = self._views[self._view.value]
            for handle, picture in zip(self._pictures, run.panels(stamp)):
                handle.image = picture
