"""The layout `generic`: our own, for any camera; docs/data.md describes it.

    camera.json           required; width, height, fx, fy, cx, cy and more, see camera_file.py
    events.*              one file that `edslam_ti.event_files` reads (HDF5, npy, text, ...), or
    events/{x,y,t,p}.npy  columns: pixel column and row, seconds (float64), polarity
    depth.txt             lines 'stamp path'; PNG of 16 bits in 1/depth_scale metres, or OpenEXR in metres
    images.txt            lines 'stamp path', optional; PNG, JPEG, or OpenEXR with brightness 0 to 1
    truth.txt             optional; t tx ty tz qx qy qz qw, camera to world (TUM); or
    poses_ts.txt, traj.txt       a time a line, and T_world_camera (16 numbers) a line
    imu.txt               optional; t gx gy gz ax ay az, rad/s and m/s^2
    depth_camera.json     optional; the depth camera where it is another than the event camera: fields as in
                          camera.json, and T_events_depth; depth is drawn into the event camera
    novel_views/, surfaces.ply   optional, for evaluation only; as in event_replica

Stamps are seconds on one clock: from 0, since boot, or since the epoch. A late clock is shifted (clocks.py);
`time_offset` in camera.json is added for the recording's own clock. Pixel centres are at integers unless
camera.json says "half". Without events the methods that need none can be run; without depth, none can.
"""

from pathlib import Path

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import EventDepthSequence, NovelView
from edslam_ti.datasets.calibration import rigid_motion
from edslam_ti.datasets.camera_file import CameraFile, read_camera
from edslam_ti.datasets.clocks import check_clock, clock_offset, note_coverage
from edslam_ti.datasets.depth import look_at_images, read_depth
from edslam_ti.datasets.exr import read_grey
from edslam_ti.datasets.files import read_timed_paths
from edslam_ti.datasets.imu import read_imu_text
from edslam_ti.datasets.novel_views import read_novel_views
from edslam_ti.datasets.truth import read_timed_poses
from edslam_ti.depth_reprojection import DepthReprojection
from edslam_ti.errors import DataError, plain
from edslam_ti.event_files import EventStream, open_events
from edslam_ti.events import Events
from edslam_ti.lenses import Undistortion
from edslam_ti.trajectory import Trajectory, read_tum

INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")
COLUMNS = tuple(f"{name}.npy" for name in "xytp")
OTHER_LAYOUTS = ("calib.txt", "rgb.txt")  # of rpg, and of TUM RGB-D


class GenericSequence(EventDepthSequence):
    """A folder in the layout `generic`."""

    dataset = "generic"

    def __init__(self, folder: Path, contrast_threshold: float | None = None) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: sequence folder not found")
        self.scene, self._folder = folder.name, folder
        surfaces = folder / "surfaces.ply"
        self.surfaces_file = surfaces if surfaces.is_file() else None
        calibration = read_calibration(folder / "camera.json")
        self.camera, lens = calibration.camera, calibration.lens
        try:
            self._undistortion = Undistortion(lens) if lens.is_distorted else None
        except DataError as error:
            raise DataError(f"{folder / 'camera.json'}: {error}") from error
        self._depth_is_undistorted = calibration.depth_undistorted
        self.description = calibration.description or f"generic layout, {plain(folder)}"
        self.exposure, self.preset = calibration.exposure, calibration.preset
        self.contrast_threshold = calibration.contrast_threshold
        self._depth_format = calibration.depth_format()
        self._source, self._reprojection = self._depth_camera(folder)
        self._events: EventStream | None = self._open_events(folder)
        depth_times, self._depth_files = _listed(folder / "depth.txt")
        image_times, self._image_files = _listed(folder / "images.txt")
        self.has_events = self._events is not None
        if self._events is None and len(depth_times) == 0:
            raise DataError(
                f"{folder}: expected events (events.h5, events/x.npy, ...) or depth.txt, got neither"
            )
        first = self._events.time_range[0] if self._events is not None else float(depth_times[0])
        self._shift = clock_offset(first)
        self.time_offset = self._shift + calibration.time_offset
        if self._events is not None and self._shift:
            self._events = self._events.shifted(self._shift)
        self.depth_timestamps, self.image_timestamps = depth_times - self._shift, image_times - self._shift
        for name, times in (("depth.txt", self.depth_timestamps), ("images.txt", self.image_timestamps)):
            check_clock(self, folder, name, times)
        if len(depth_times):
            note_coverage(self)
        else:
            self.note(f"{folder}: no depth.txt, so there is no depth: expected lines 'stamp path'")
        self.truth = self._read_truth(folder)
        if (folder / "imu.txt").is_file():
            self.imu = read_imu_text(folder / "imu.txt", 7, "t gx gy gz ax ay az").shifted(self._shift)
            check_clock(self, folder, "imu.txt", self.imu.timestamps)
        look_at_images(self, folder)  # find faults now, not in the middle of a run

    def _depth_camera(self, folder: Path) -> tuple[Camera, DepthReprojection | None]:
        """Return the camera of depth images, and what draws them into the event camera if it is another."""
        path = folder / "depth_camera.json"
        if not path.is_file():
            return self.camera, None
        stated = read_calibration(path)
        if stated.T_events_depth is None:
            raise DataError(
                f"{path}: expected T_events_depth, 16 numbers, from the depth to the event camera"
            )
        self._depth_format = stated.depth_format()
        T = rigid_motion(stated.T_events_depth, f"{path}: T_events_depth")
        return stated.camera, DepthReprojection(stated.lens, self.camera, T)

    def _open_events(self, folder: Path) -> EventStream | None:
        path = events_in(folder)
        if path is None:
            return None
        events = open_events(path, self.camera.shape[::-1])
        self.num_dropped_events = events.num_dropped
        for text in events.notes:
            self.note(f"{path}: {text}")
        return events

    def _read_truth(self, folder: Path) -> Trajectory | None:
        names = [name for name in ("truth.txt", "poses_ts.txt") if (folder / name).exists()]
        if len(names) > 1:
            raise DataError(f"{folder}: holds true poses twice, in {' and '.join(names)}; keep one")
        if not names:
            return None
        notes: list[str] = []
        if names == ["truth.txt"]:
            truth = read_tum(folder / "truth.txt", notes)
        else:
            truth, notes = read_timed_poses(folder / "poses_ts.txt", folder / "traj.txt")
        for text in notes:
            self.note(text)
        truth = Trajectory(truth.timestamps - self._shift, truth.poses)
        check_clock(self, folder, names[0], truth.timestamps)
        return truth

    @property
    def time_range(self) -> tuple[float, float]:
        if self._events is not None:
            return self._events.time_range
        return float(self.depth_timestamps[0]), float(self.depth_timestamps[-1])

    def events(self, start: float, end: float) -> Events:
        if self._events is None:
            return Events.empty()
        events = self._events.between(start, end)
        return events if self._undistortion is None else self._undistortion.events(events)

    def depth(self, index: int) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
        depth = read_depth(self._depth_files[index], self._source, self._depth_format)
        if self._reprojection is not None:
            return self._reprojection(depth)
        if self._undistortion is None or self._depth_is_undistorted:
            return depth
        return self._undistortion.depth(depth)

    def image(self, index: int) -> np.ndarray:  # [H, W] float32 in [0, 1]
        image = read_grey(self._image_files[index], self.camera)
        return image if self._undistortion is None else self._undistortion.image(image)

    def novel_views(self) -> list[NovelView]:
        return read_novel_views(self._folder, self.camera, self._depth_format, self._shift)


def events_in(folder: Path) -> Path | None:
    """Return the file of events, or the folder of their columns; None: there are none.

    Raises `DataError` if there are several.
    """
    files = [path for path in sorted(folder.glob("events.*")) if path.is_file() and path.name[0] != "."]
    if all((folder / "events" / name).is_file() for name in COLUMNS):
        files.append(folder / "events")
    if len(files) > 1:
        raise DataError(f"{folder}: holds events in {' and in '.join(p.name for p in files)}; keep one")
    return files[0] if files else None


def is_generic(folder: Path) -> bool:
    """Return whether a folder holds camera.json with events or depth where this layout has them."""
    if not (folder / "camera.json").is_file() or any((folder / name).exists() for name in OTHER_LAYOUTS):
        return False
    if any(folder.glob("event_threshold_*")):  # event_replica
        return False
    has_columns = (folder / "events" / COLUMNS[0]).is_file()
    return (folder / "depth.txt").is_file() or has_columns or any(folder.glob("events.*"))


def read_calibration(path: Path) -> CameraFile:
    """Return a camera.json that states size and lens; pixel centres are at integers unless it says half."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} not found; expected {', '.join(INTRINSICS)}, and depth_scale")
    calibration = read_camera(path)
    missing = [name for name in INTRINSICS if name not in calibration.model_fields_set]
    if missing:
        raise DataError(f"{path}: expected {', '.join(INTRINSICS)}, got no {', '.join(missing)}")
    if "pixel_centres" not in calibration.model_fields_set:
        return calibration.model_copy(update={"pixel_centres": "integer"})
    return calibration


def _listed(path: Path) -> tuple[np.ndarray, list[Path]]:  # [I] s, I files
    return read_timed_paths(path) if path.is_file() else (np.empty(0), [])
