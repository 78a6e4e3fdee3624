"""Records a scene along a camera path, in EventReplica's layout on disk.

poses_ts.txt, traj.txt          times (s) and camera-to-world poses (16 numbers, OpenCV axes), one per image
images/frameNNNNNN.png          grey, 8 bit; NNNNNN = milliseconds
depth/frameNNNNNN.png           uint16, 5000 units per metre, 0 = missing
event_threshold_C/gray_events_data.npy    [N, 4] float64 (or float32): x, y, t (s), polarity -1/+1, by time
camera.json, README.txt         intrinsics and settings; what this is
novel_views/, surfaces.ply      for evaluation only, see truth.py
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from edslam_ti.camera import NEAREST, Camera
from edslam_ti.errors import DataError
from edslam_ti.kernels.event_simulation import EventArrays
from edslam_ti.output import atomic_folder, check_replaceable, write_npy_header
from edslam_ti.sensor_config import DepthSensorConfig, SensorConfig
from edslam_ti.simulation.event_sensor import make_sensor
from edslam_ti.simulation.moving import MovingObject, MovingRenderer
from edslam_ti.simulation.paths import CameraPath
from edslam_ti.simulation.recorded_images import DepthWriter, ImageWriter
from edslam_ti.simulation.renderer import Render
from edslam_ti.simulation.scene import Scene
from edslam_ti.simulation.settings import SimulationConfig
from edslam_ti.simulation.truth import DEPTH_UNITS_PER_METRE, write_evaluation_truth

MILLISECOND = 1_000_000  # nanoseconds
TITLE = "Simulated recording"  # how README.txt begins
UNKNOWN = "unknown"  # C of a sensor with faults, which nobody knows exactly
FILES = ("README.txt", "camera.json", "poses_ts.txt", "traj.txt", "surfaces.ply")
PICTURES = ("images", "depth", "novel_views/images", "novel_views/depth")


@dataclass(frozen=True)
class RecordingSummary:
    """Numbers of what was written."""

    folder: Path
    num_events: int
    num_rendered_frames: int
    num_images: int
    num_depth_images: int
    duration: float  # seconds


def simulate(
    scene: Scene,
    path: CameraPath,
    config: SimulationConfig,
    out: Path,
    progress: Callable[[float], None] | None = None,
    moving: MovingObject | None = None,
) -> RecordingSummary:
    """Write the recording to the folder `out`; Taichi must have been started.

    `out` is a new or an empty folder, or an older simulated recording, which is replaced.
    Frames are rendered so that nothing moves more than `config.max_motion` pixels between two of them,
    and at every image and depth time. `moving` is an object in the scene; novel views and true surfaces are
    without it. `progress` receives the share done, 0 to 1.
    """
    duration = min(config.duration, path.duration)
    image_times = _millisecond_times(config.image_rate, duration)
    depth_sensor = config.depth_measured_by
    depth_times = [
        t
        for t in _millisecond_times(depth_sensor.rate or config.depth_rate, duration, depth_sensor.phase)
        if not _is_in(config.depth_gap, t)
    ]
    if min(len(image_times), len(depth_times)) < 2:
        raise DataError(
            f"recording of {duration:g} s: expected at least two images and two depth images; "
            "use a longer duration or trajectory, or higher rates"
        )
    end = round(duration * 1e9)
    check_replaceable(out, why_not_a_recording)
    renderer = MovingRenderer(scene, moving, config.camera, config.samples_per_pixel)
    times = _FrameTimes(config, path, sorted({*image_times, *depth_times, end}))
    with atomic_folder(out, why_not_a_recording) as folder:
        for name in ("images", "depth"):
            (folder / name).mkdir()
        known = f"{config.contrast_threshold:g}" if config.states_threshold else UNKNOWN
        threshold = folder / f"event_threshold_{known}"
        threshold.mkdir()
        images = ImageWriter(folder / "images", image_times, config.exposure)
        depths = DepthWriter(folder / "depth", set(depth_times), config, path, renderer)
        now, num_frames = 0, 1
        render = renderer.render(path.pose(0.0), 0.0)
        sensor = make_sensor(config, _log_intensity(render, config))
        depths.add(now, render)
        file = threshold / "gray_events_data.npy"
        with EventFileWriter(file, np.float32 if config.compact_events else np.float64) as events:
            while now < end:
                following = times.after(now, render.depth)
                render_next = renderer.render(path.pose(following / 1e9), following / 1e9)
                fired = sensor.advance(_log_intensity(render_next, config), following)
                events.append(_without_gap(fired, config.event_gap))
                images.add(now, render.grey, following, render_next.grey)
                depths.add(following, render_next)
                now, render = following, render_next
                num_frames += 1
                if progress:
                    progress(now / end)
            images.finish()
        if events.count == 0:
            raise DataError(f"recording of {duration:g} s: no event fired; {_why_no_event(render)}")
        pose_times = image_times
        if config.pose_rate is not None:
            pose_times = _millisecond_times(config.pose_rate, duration)
        _write_poses(folder, path, pose_times)
        _write_descriptions(folder, scene, config)
        write_evaluation_truth(folder, scene, config.camera, config.samples_per_pixel, path.pose, end / 1e9)
    return RecordingSummary(out, events.count, num_frames, len(image_times), len(depth_times), duration)


def _why_no_event(render: Render) -> str:
    """Return what the last view tells about a recording without events."""
    if not render.depth.any():
        return "the camera sees no surface; check where it is put, and the scales of mesh and trajectory"
    if render.grey.std() < 0.01:
        return "what the camera sees is of one brightness; check the texture and where it looks"
    return "brightness changes by less than the contrast threshold; use a longer or faster motion"


def why_not_a_recording(folder: Path) -> str | None:
    """Return what shows that a folder is not, or not only, a simulated recording; None: it is one."""
    try:
        with (folder / "README.txt").open("rb") as file:
            title = file.read(len(TITLE)).decode(errors="replace")
    except OSError:
        title = ""
    if title != TITLE:
        return "holds something else than a simulated recording"
    for path in _entries(folder):
        name = path.relative_to(folder).as_posix()
        parent = path.parent.relative_to(folder).as_posix()
        is_known = (
            name in (*FILES, "novel_views/traj.txt")
            or (parent in PICTURES and path.match("frame*.png"))
            or path.match("event_threshold_*/gray_events_data.npy")
        )
        if not is_known or not path.is_file() or path.is_symlink():
            return f"holds '{name}' beside a simulated recording"
    return None


def _entries(folder: Path) -> Iterator[Path]:
    """Yield all files and links below a folder."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            yield from _entries(path)
        else:
            yield path


def _log_intensity(render: Render, config: SimulationConfig) -> np.ndarray:  # [H, W] float32
    return np.log(render.grey + np.float32(config.log_epsilon))


def _millisecond_times(rate: float, duration: float, phase: float = 0.0) -> list[int]:
    """Return times phase + k / rate up to the duration, rounded to whole milliseconds, in nanoseconds."""
    count = int(np.floor(duration * rate + 1e-6)) + 1
    stamps = [round(1e3 * phase + 1e3 * k / rate) * MILLISECOND for k in range(count)]
    return sorted({t for t in stamps if t <= round(duration * 1e9)})


def _is_in(gap: tuple[float, float] | None, t: int) -> bool:
    """Return whether a time in nanoseconds lies in a gap (start and length in seconds)."""
    return gap is not None and gap[0] <= t / 1e9 < gap[0] + gap[1]


def _without_gap(events: EventArrays, gap: tuple[float, float] | None) -> EventArrays:
    if gap is None:
        return events
    seconds = events.t / 1e9
    kept = (seconds < gap[0]) | (seconds >= gap[0] + gap[1])
    return EventArrays(events.x[kept], events.y[kept], events.t[kept], events.polarity[kept])


class _FrameTimes:
    """Chooses the times of rendered frames, in nanoseconds."""

    def __init__(self, config: SimulationConfig, path: CameraPath, required: list[int]) -> None:
        self._camera = config.camera
        self._path = path
        self._max_motion = config.max_motion
        self._longest = round(1e9 / config.min_frame_rate)
        self._required = np.array(required)
        self._step = self._longest

    def after(self, now: int, depth: np.ndarray) -> int:
        """Return the next frame's time: at most `max_motion` pixels later, never beyond a required time."""
        step = min(self._longest, round(1.5 * self._step))
        for _ in range(4):
            motion = self._motion(now, now + step, depth)
            if motion <= 1.02 * self._max_motion:
                break
            step = max(round(step * 0.98 * self._max_motion / motion), 20_000)
        self._step = step
        left = int(self._required[np.searchsorted(self._required, now, side="right")]) - now
        pieces = int(np.ceil(left / step))
        return now + left if pieces <= 1 else now + min(step, round(left / pieces))

    def _motion(self, start: int, end: int, depth: np.ndarray) -> float:
        """Return the 95th percentile of the image motion (pixels) of points visible at `start`."""
        camera = self._camera
        rows = np.linspace(0, camera.height - 1, 15).astype(int)
        columns = np.linspace(0, camera.width - 1, 21).astype(int)
        v, u = (a.ravel() for a in np.meshgrid(rows, columns, indexing="ij"))
        z = depth[v, u].astype(np.float64)
        v, u, z = v[z > 0], u[z > 0], z[z > 0]
        if len(z) == 0:
            return 0.0
        points = camera.back_project_pixels(u, v, z)
        T = np.linalg.inv(self._path.pose(end / 1e9)) @ self._path.pose(start / 1e9)
        later_u, later_v, _ = camera.project(points @ T[:3, :3].T + T[:3, 3], NEAREST)
        return float(np.percentile(np.hypot(later_u - u, later_v - v), 95))


class EventFileWriter:
    """Appends events to an .npy file [N, 4] whose length is filled in at the end."""

    def __init__(self, path: Path, dtype: type[np.floating[Any]] = np.float64) -> None:
        self.count = 0
        self._dtype = np.dtype(dtype)
        self._file = path.open("wb")
        write_npy_header(self._file, self._dtype, 0, 4)

    def append(self, events: EventArrays) -> None:
        """Write events as rows x, y, t (s), polarity."""
        rows = np.empty((len(events.t), 4), self._dtype)
        rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = events.x, events.y, events.t / 1e9, events.polarity
        self._file.write(rows.tobytes())
        self.count += len(rows)

    def __enter__(self) -> "EventFileWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        write_npy_header(self._file, self._dtype, self.count, 4)
        self._file.close()


def _write_poses(folder: Path, path: CameraPath, times: list[int]) -> None:
    """Write times and poses, one per line."""
    with (folder / "poses_ts.txt").open("w") as stamps, (folder / "traj.txt").open("w") as poses:
        for t in times:
            stamps.write(f"{t / 1e9:.6f}\n")
            poses.write(" ".join(f"{value:.12g}" for value in path.pose(t / 1e9).ravel()) + "\n")


def _write_descriptions(folder: Path, scene: Scene, config: SimulationConfig) -> None:
    """Write camera.json and README.txt."""
    camera: Camera = config.camera
    values = {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "pixel_centres": "integer",
        "contrast_threshold": config.contrast_threshold if config.states_threshold else None,
        "depth_scale": DEPTH_UNITS_PER_METRE,
        "exposure": config.exposure,
        "description": scene.description,
    }
    stated = {name: value for name, value in values.items() if value is not None}
    (folder / "camera.json").write_text(json.dumps(stated, indent=2) + "\n")
    settings = "\n".join(f"  {key}: {value}" for key, value in _shown_settings(config).items())
    (folder / "README.txt").write_text(
        f"{TITLE}: {scene.description}.\n\n"
        "poses_ts.txt, traj.txt: seconds and camera-to-world pose (16 numbers, row-major; x right, y down,\n"
        "z forward). images/: 8-bit grey. depth/: uint16, "
        f"{DEPTH_UNITS_PER_METRE} units per metre, 0 = missing.\n"
        "File names are milliseconds; depth may be at other times than the poses.\n"
        "gray_events_data.npy: rows x, y, t (s), polarity -1/+1, sorted by time; a change of\n"
        f"log(grey + {config.log_epsilon:.6g}) by the contrast threshold fires an event, grey in [0, 1].\n"
        "Pixel centres are at integer coordinates.\n"
        "novel_views/: true views near the path, depth exact; surfaces.ply: the scene's triangles (m).\n\n"
        f"Settings:\n{settings}\n"
    )


def _shown_settings(config: SimulationConfig) -> dict[str, Any]:
    """Return the settings by name, those of the sensor with the preset's values, if there are faults."""
    values = config.model_dump(exclude={"sensor", "depth_sensor"})
    if config.sensor != SensorConfig():
        values["sensor"] = config.sensor.preset
        values |= {f"sensor.{name}": value for name, value in config.sensor.facts.items()}
    if config.depth_sensor != DepthSensorConfig():
        values["depth_sensor"] = config.depth_sensor.preset
        values |= {f"depth_sensor.{name}": value for name, value in config.depth_sensor.facts.items()}
    return values
