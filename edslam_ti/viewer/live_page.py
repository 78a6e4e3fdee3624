"""What is on the page of a run that goes on: its parts, its buttons, its curves."""

import threading
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import plain
from edslam_ti.viewer.moment import Moment
from edslam_ti.viewer.server import add_lines, add_screenshot_button, look_through, place_eye, set_up, words
from edslam_ti.viewer.shapes import (
    KEYFRAME_COLOUR,
    PATH_COLOUR,
    TRUTH_COLOUR,
    frustum_lines,
    path_lines,
)
from edslam_ti.viewer.splats import Block, SplatStream

PICTURES = ("events", "brightness", "depth", "render")
CURVES = {"error": "error so far, cm", "loss": "loss", "hertz": "Hz", "gaussians": "Gaussians"}
MOST_VALUES = 300  # of a curve; beyond, every second value goes
NEWEST_COLOUR = "#009E73"
FRUSTUM, NEWEST_FRUSTUM = 0.05, 0.1  # metres


@dataclass
class Update:
    """What a page is told at once; parts that are None stay as they are."""

    poses: np.ndarray  # [F, 4, 4] copied
    camera: Camera
    keyframes: list[int]
    curves: dict[str, np.ndarray]  # [N] by name
    text: str
    truth: np.ndarray | None = None  # [N, 4, 4] the true path
    pictures: dict[str, np.ndarray] = field(default_factory=dict)  # [H, W, 3] uint8, by name
    blocks: list[Block] = field(default_factory=list)
    points: tuple[np.ndarray, np.ndarray] | None = None  # [N, 3] metres, [N] brightness


class LivePage:
    """The page; `show` is called from one thread only, its buttons from others."""

    def __init__(self, server: Any, viser: Any, stream: SplatStream) -> None:
        self._server, self._viser, self._stream = server, viser, stream
        self._curves: dict[str, list[float]] = {name: [] for name in ("frame", *CURVES)}
        self._every, self._num_notes = 1, 0  # every n-th value is kept
        self._opened_with = 0  # poses when the opening view was set
        self._whole_path = np.empty((0, 4, 4))  # known before the run is through
        self._lock = threading.Lock()
        self._is_paused, self._steps = False, 0
        gui = server.gui
        self._status = gui.add_html(words("waiting for the first frame"))
        self._pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT, hint="one frame further")
        self._follow = gui.add_checkbox("Follow camera", False)
        self._pause.on_click(lambda event: self._set_paused(not self._is_paused))
        self._step.on_click(lambda event: self._make_step())
        add_screenshot_button(server)
        tabs = gui.add_tab_group()
        blank = np.full((60, 96, 3), 235, np.uint8)
        with tabs.add_tab("Images"):
            self._images = {name: gui.add_image(blank, label=name, format="jpeg") for name in PICTURES}
        with tabs.add_tab("Curves"):
            self._plots = {name: self._add_plot(name, title) for name, title in CURVES.items()}

    def _add_plot(self, name: str, title: str) -> Any:
        uplot = self._viser.uplot
        return self._server.gui.add_uplot(
            data=(np.array([0.0, 1.0]), np.array([0.0, 0.0])),
            series=(uplot.Series(label="frame"), uplot.Series(label=name, stroke=PATH_COLOUR, width=2)),
            scales={"x": uplot.Scale(time=False)},
            title=title,
            aspect=2.4,
        )

    # --- buttons ---

    def _set_paused(self, is_paused: bool) -> None:
        with self._lock:
            self._is_paused, self._steps = is_paused, 0
        self._pause.label = "Continue" if is_paused else "Pause"

    def _make_step(self) -> None:
        self._set_paused(True)
        with self._lock:
            self._steps = 1

    def is_held(self) -> bool:
        """Return whether the run is to wait; a step that was asked for is taken."""
        with self._lock:
            if self._is_paused and self._steps > 0:
                self._steps -= 1
                return False
            return self._is_paused

    # --- numbers ---

    def note_numbers(self, moment: Moment) -> None:
        """Keep the numbers of the newest frame for the curves."""
        self._num_notes += 1
        if moment.sample is None or self._num_notes % self._every:
            return
        mapper = moment.mapper
        values = {
            "frame": float(len(moment.trajectory)),
            "error": np.nan if moment.error_cm is None else moment.error_cm,
            "loss": np.nan if mapper is None else mapper.loss,
            "hertz": moment.hertz,
            "gaussians": np.nan if mapper is None else float(mapper.num_gaussians),
        }
        for name, value in values.items():
            self._curves[name].append(float(value))
        if len(self._curves["frame"]) > MOST_VALUES:
            self._every *= 2
            for curve in self._curves.values():
                del curve[::2]

    def newest_curves(self) -> dict[str, np.ndarray]:
        """Return copies of the curves."""
        return {name: np.array(values) for name, values in self._curves.items()}

    def status(self, moment: Moment) -> str:
        """Return how far the run is, as HTML."""
        stage = "refining the map" if moment.sample is None else "running"
        of_all = f" of {moment.num_frames}" if moment.num_frames else ""
        parts = [f"{stage}: frame {len(moment.trajectory)}{of_all}, {moment.hertz:.1f} Hz"]
        if moment.mapper is not None:
            parts.append(f"{moment.mapper.num_gaussians:,} Gaussians, loss {moment.mapper.loss:.3f}")
        if moment.error_cm is not None:
            parts.append(f"error so far {moment.error_cm:.2f} cm")
        if moment.slam.results and not moment.slam.results[-1].converged:
            parts.append(f"lost: {plain(moment.slam.results[-1].message, 100)}")
        return words(*parts)

    # --- what is shown ---

    def show(self, update: Update) -> None:
        """Send an update to the pages."""
        poses = update.poses
        self._place_eye(update)
        for block in update.blocks:
            self._stream.send(block, poses, update.camera)
        if update.points is not None:
            points, brightness = update.points
            colors = np.repeat(np.clip(brightness, 0, 1)[:, None], 3, axis=1)
            self._server.scene.add_point_cloud("/points", points, colors, point_size=0.01)
        if update.truth is not None and len(update.truth) > 1:
            add_lines(self._server, "/truth", path_lines(update.truth[:, :3, 3]), TRUTH_COLOUR, 1.5)
        if len(poses) > 1:
            add_lines(self._server, "/path", path_lines(poses[:, :3, 3]), PATH_COLOUR, 3.0)
        keyframes = [poses[k] for k in update.keyframes if k < len(poses)]
        frusta = [line for T in keyframes for line in frustum_lines(T, update.camera, FRUSTUM)]
        if frusta:
            add_lines(self._server, "/keyframes", frusta, KEYFRAME_COLOUR, 1.5)
        add_lines(
            self._server,
            "/camera",
            frustum_lines(poses[-1], update.camera, NEWEST_FRUSTUM),
            NEWEST_COLOUR,
            3.0,
        )
        for name, picture in update.pictures.items():
            self._images[name].image = picture
        self._status.content = update.text
        self._draw_curves(update.curves)
        if self._follow.value:
            for client in self._server.get_clients().values():
                look_through(client, poses[-1])

    def _place_eye(self, update: Update) -> None:
        """Let new pages open with the whole path in sight; of the true one where that is known."""
        if update.truth is not None:
            self._whole_path = update.truth
        if len(update.poses) > 1.2 * self._opened_with:
            if self._opened_with == 0:
                set_up(self._server, update.poses)
            self._opened_with = len(update.poses)
            path = np.concatenate([update.poses, self._whole_path])
            place_eye(self._server, path, update.camera.height / 2 / update.camera.fy)

    def _draw_curves(self, curves: dict[str, np.ndarray]) -> None:
        for name, plot in self._plots.items():
            is_known = np.isfinite(curves[name])
            if is_known.sum() > 1:
                plot.data = (curves["frame"][is_known], curves[name][is_known])

    def end(self) -> None:
        """Say that the run has ended."""
        self._status.content = words("the run has ended; edslam view RESULT --viewer shows it again")
