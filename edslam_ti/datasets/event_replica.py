"""EventReplica's layout (IncEventGS): one folder of events, depth, and perhaps images and poses.

    poses_ts.txt                               one time a line, seconds            } both or neither
    traj.txt                                   16 numbers a line, T_world_camera   }
    images/frameNNNNNN.{jpg,png}               grey or colour, optional
    event_threshold_<C>/gray_events_data.npy   (N, 4): x, y, t [s], p
    depth/frameNNNNNN.png                      16 bits, 1/depth_scale metres, 0 = missing; or
    Depth_exr/*.exr                            metres (used when there is no depth/frame*.png)
    camera.json                                optional
    novel_views/{images,depth}/frameNNNNNN.png, novel_views/traj.txt
                                               true views beside the path (same units), optional
    surfaces.ply                               true surfaces, metres, optional

NNNNNN is the time in milliseconds, with any number of digits. `camera.json` may hold any of {width,
height, fx, fy, cx, cy, pixel_centres: "integer" | "half", contrast_threshold, depth_scale, exposure};
what it leaves out is EventReplica's own camera. With centres at "half" (EventReplica's, seen from cx =
width / 2) the first pixel is centred at (0.5, 0.5); the sequence's `camera` has them at integers.

Clock: the files' own, in seconds. A recording whose first event is later than `LATEST_START` (stamps
since the epoch or since boot) is shifted so that it starts at 0; `time_offset` holds the shift.
"""

import difflib
import json
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import EventDepthSequence, NovelView
from edslam_ti.datasets.event_file import EventFile
from edslam_ti.datasets.files import numbered_files, read_depth, read_image, read_numbers
from edslam_ti.errors import DataError
from edslam_ti.events import Events
from edslam_ti.geometry import orthonormalized
from edslam_ti.trajectory import Trajectory

LATEST_START = 1000.0  # s; kernels count integer microseconds in 32 bits, which end at 2147 s
EVENTS = "gray_events_data.npy"
THRESHOLD = "event_threshold_"
DISTORTION_KEYS = ("distortion", "distortion_coefficients", "dist", "k1", "k2", "k3", "p1", "p2")


class CameraFile(BaseModel):
    """camera.json; the defaults are EventReplica's camera (IncEventGS, configs/SimuEvent)."""

    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)

    width: int = Field(768, ge=1, le=32767)
    height: int = Field(480, ge=1, le=32767)
    fx: float = Field(384.0, gt=0)
    fy: float = Field(384.0, gt=0)
    cx: float = 384.0
    cy: float = 240.0
    pixel_centres: Literal["integer", "half"] = "half"
    contrast_threshold: float | None = Field(None, gt=0)
    """C of Eq. 11; also chooses among several event folders."""
    depth_scale: float = Field(1000.0, gt=0)
    """Units of depth/*.png in a metre (1000: millimetres); below 1, metres in a unit (0.001: the same)."""
    exposure: float | None = Field(None, ge=0, lt=1)
    """Seconds over which an image integrates, centred on its time; 0: sharp."""
    frame_rate: float = Field(30.0, gt=0)
    """Images a second, for layouts whose files carry a number but no time (not EventReplica's)."""
    description: str | None = None
    """What the recording is; simulated ones say so here, and results repeat it."""

    @property
    def camera(self) -> Camera:
        """The pinhole camera with pixel centres at integers."""
        shift = 0.5 if self.pixel_centres == "half" else 0.0
        return Camera(self.width, self.height, self.fx, self.fy, self.cx - shift, self.cy - shift)

    @property
    def metres_per_unit(self) -> float:
        return self.depth_scale if self.depth_scale < 1 else 1 / self.depth_scale


def read_camera(path: Path) -> CameraFile:
    """Read camera.json; a missing file gives EventReplica's camera."""
    if not path.is_file():
        return CameraFile()
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: calibration not readable as JSON: {error}") from error
    if not isinstance(values, dict):
        raise DataError(f'{path}: expected an object {{"width": 768, ...}}, got {type(values).__name__}')
    for key in values.keys() - CameraFile.model_fields.keys():
        close = difflib.get_close_matches(key.lower(), CameraFile.model_fields, n=1, cutoff=0.8)
        if close:
            raise DataError(f"{path}: unknown key '{key}'; did you mean '{close[0]}'?")
        if key.lower() in DISTORTION_KEYS and values[key] and np.any(np.asarray(values[key], object) != 0):
            raise DataError(f"{path}: '{key}': expected an undistorted camera; undistort the data first")
    try:
        result = CameraFile.model_validate(
            {k: int(v) if isinstance(v, float) and v.is_integer() and k in ("width", "height") else v
             for k, v in values.items()}
        )  # fmt: skip
    except ValidationError as error:
        problem = error.errors()[0]
        name = ".".join(str(part) for part in problem["loc"])
        raise DataError(f"{path}: {name}: {problem['msg']}, got {problem['input']!r}") from error
    if not (0 < result.cx < result.width and 0 < result.cy < result.height):
        raise DataError(
            f"{path}: expected the principal point inside the {result.width}x{result.height} image, got "
            f"cx = {result.cx}, cy = {result.cy}; give width, height, fx, fy, cx and cy together"
        )
    return result


class EventReplicaSequence(EventDepthSequence):
    """A folder in EventReplica's layout; any scene name works.

    Where the folder holds events simulated with several thresholds, `contrast_threshold` chooses one.
    """

    dataset = "event_replica"

    def __init__(self, folder: Path, contrast_threshold: float | None = None) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: sequence folder not found")
        self.scene = folder.name
        self._folder = folder
        surfaces = folder / "surfaces.ply"
        self.surfaces_file = surfaces if surfaces.is_file() else None
        calibration = read_camera(folder / "camera.json")
        self.description = calibration.description or f"EventReplica layout, {folder}"
        self.camera = calibration.camera
        self.exposure = calibration.exposure
        self._metres_per_unit = calibration.metres_per_unit
        events_folder, self.contrast_threshold = _event_folder(
            folder, contrast_threshold, calibration.contrast_threshold
        )
        self._events = EventFile(events_folder / EVENTS, self.camera.width, self.camera.height)
        self.num_dropped_events = self._events.num_dropped

        first, _ = self._events.time_range
        self.time_offset = first if abs(first) > LATEST_START else 0.0
        if self.time_offset:
            self._events = self._events.shifted(self.time_offset)

        depth = numbered_files(folder / "depth", "frame*", (".png",))
        depth = depth or numbered_files(folder / "Depth_exr", "*", (".exr",))
        if not depth:
            raise DataError(
                f"{folder}: no depth found; expected depth/frameNNNNNN.png (16 bits) or Depth_exr/*.exr with "
                "NNNNNN in milliseconds (EventReplica ships none: render it at its poses)"
            )
        images = numbered_files(folder / "images", "frame*", (".jpg", ".jpeg", ".png"))
        self._depth_files, self.depth_timestamps = self._with_times(depth)
        self._image_files, self.image_timestamps = self._with_times(images)
        self.truth = self._read_truth(folder)
        self._check_clocks(folder)
        self.depth(0)  # a wrong size or scale shows now, not in the middle of a run
        if images:
            self.image(0)

    @property
    def time_range(self) -> tuple[float, float]:
        return self._events.time_range

    def events(self, start: float, end: float) -> Events:
        return self._events.between(start, end)

    def depth(self, index: int) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
        return read_depth(self._depth_files[index], self.camera, self._metres_per_unit)

    def image(self, index: int) -> np.ndarray:  # [H, W] float32 in [0, 1]
        return read_image(self._image_files[index], self.camera)

    def novel_views(self) -> list[NovelView]:
        folder = self._folder / "novel_views"
        if not folder.is_dir():
            return []
        images, depths = (numbered_files(folder / name, "frame*", (".png",)) for name in ("images", "depth"))
        poses_file = folder / "traj.txt"
        poses = read_numbers(poses_file, 16, "the 4x4 matrix T_world_camera, row by row").reshape(-1, 4, 4)
        check_rigid(poses, poses_file)
        if list(images) != list(depths) or len(images) != len(poses):
            raise DataError(
                f"{folder}: expected an image, a depth image of the same name and a pose for every view, got "
                f"{len(images)} images, {len(depths)} depth images and {len(poses)} poses"
            )
        return [
            NovelView(
                ms / 1000 - self.time_offset,
                read_image(images[ms], self.camera),
                read_depth(depths[ms], self.camera, self._metres_per_unit),
                orthonormalized(T),
            )
            for ms, T in zip(images, poses)
        ]

    def _with_times(self, files: dict[int, Path]) -> tuple[list[Path], np.ndarray]:
        """Return the files and their times (s), from milliseconds in their names."""
        return list(files.values()), np.array([ms / 1000 for ms in files]) - self.time_offset

    def _read_truth(self, folder: Path) -> Trajectory | None:
        times_file, poses_file = folder / "poses_ts.txt", folder / "traj.txt"
        if not times_file.exists() and not poses_file.exists():
            return None
        if not (times_file.exists() and poses_file.exists()):
            present, missing = (times_file, poses_file) if times_file.exists() else (poses_file, times_file)
            raise DataError(
                f"{folder}: {present.name} is there but {missing.name} is not; expected both or neither"
            )
        times = read_numbers(times_file, 1, "time [s]")[:, 0]
        poses = read_numbers(poses_file, 16, "the 4x4 matrix T_world_camera, row by row").reshape(-1, 4, 4)
        if len(times) != len(poses):
            raise DataError(
                f"{folder}: expected one pose per time, got {len(times)} times in poses_ts.txt and "
                f"{len(poses)} poses in traj.txt"
            )
        steps = np.diff(times)
        if (steps <= 0).any():
            row = int((steps <= 0).argmax())
            raise DataError(
                f"{times_file}: expected increasing times, got {times[row]} then {times[row + 1]} "
                f"(line {row + 2})"
            )
        check_rigid(poses, poses_file)
        return Trajectory(times - self.time_offset, np.array([orthonormalized(T) for T in poses]))

    def _check_clocks(self, folder: Path) -> None:
        """Refuse events, depth and poses that lie at different times: one of them is in another unit."""
        first, last = self.time_range
        others = {"depth (ms in the file names)": self.depth_timestamps}
        if self.truth is not None:
            others["poses_ts.txt (s)"] = self.truth.timestamps
        for name, stamps in others.items():
            apart = stamps[-1] < first - 1 or stamps[0] > last + 1
            length = stamps[-1] - stamps[0]
            # A thousandfold difference is milliseconds taken for seconds.
            if apart or (length > 0 and not 1 / 300 < (last - first + 1e-3) / length < 300):
                raise DataError(
                    f"{folder}: events cover {first:.6g} to {last:.6g} s but {name} {stamps[0]:.6g} to "
                    f"{stamps[-1]:.6g} s; expected the same clock (event and pose times in seconds)"
                )


def check_rigid(poses: np.ndarray, path: Path) -> None:  # [F, 4, 4]
    """Refuse matrices that are not rigid motions to within 1e-3."""
    R = poses[:, :3, :3]
    deviation = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    bottom = np.abs(poses[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(1)
    bad = (deviation > 1e-3) | (bottom > 1e-3) | (np.linalg.det(R) < 0)
    if bad.any():
        row = int(bad.argmax())
        raise DataError(
            f"{path}: line {row + 1}: expected a rigid motion (rotation, translation in metres, last row "
            f"0 0 0 1), got {np.array2string(poses[row].ravel(), precision=4, max_line_width=10**6)}"
        )


def _event_folder(folder: Path, wanted: float | None, stated: float | None) -> tuple[Path, float | None]:
    """Return the event folder and its C: the only one, or the one `wanted`, or camera.json's (`stated`)."""
    candidates: dict[Path, float | None] = {}
    for path in sorted(folder.glob(f"{THRESHOLD}*")):
        if path.is_dir():
            try:
                value = float(path.name.removeprefix(THRESHOLD))
            except ValueError:
                value = 0.0
            candidates[path] = value if 0 < value < float("inf") else None
    if not candidates:
        raise FileNotFoundError(f"{folder}: no events found; expected {THRESHOLD}<C>/{EVENTS}")
    if len(candidates) == 1:
        [(path, threshold)] = candidates.items()
        return path, stated or threshold
    names = ", ".join(path.name for path in candidates)
    choice = wanted or stated
    if choice is None:
        raise DataError(f"{folder}: holds {names}; choose one with --contrast-threshold")
    for path, threshold in candidates.items():
        if threshold is not None and abs(threshold - choice) < 1e-9:
            return path, threshold
    raise DataError(f"{folder}: no events with contrast threshold {choice:g}; there are {names}")


def is_event_replica(folder: Path) -> bool:
    """Return whether a folder holds events where this layout has them."""
    return any(folder.glob(f"{THRESHOLD}*"))
