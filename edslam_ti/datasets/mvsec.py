"""MVSEC (Zhu et al. 2018): DAVIS346 stereo, depth and poses from lidar and motion capture.

    <name>_data.hdf5      davis/left/events [N, 4]: x, y, t [s], p; image_raw, image_raw_ts; imu, imu_ts
    <name>_gt.hdf5        davis/left/depth_image_rect, depth_image_raw [N, 260, 346] m, NaN = missing, each
                          with stamps _ts; pose [N, 4, 4], pose_ts
    camchain-imucam-*.yaml    Kalibr: cam0 intrinsics, equidistant distortion, projection_matrix,
                              rectification_matrix; here, in *calib/, or in one of these one folder up

Depth of the rectified camera is used where the calibration states that camera; then events and images are
rectified, too. Otherwise raw depth is undistorted, each pixel taking the nearest measurement. `pose` is taken
as T_world_camera of the (not rectified) left camera.
"""

from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.calibration import kalibr_lens, numbers, read_yaml
from edslam_ti.datasets.hdf5 import Hdf5File, only_file
from edslam_ti.datasets.imu import in_order
from edslam_ti.datasets.recording import Recording
from edslam_ti.datasets.truth import check_rigid
from edslam_ti.errors import DataError
from edslam_ti.event_files import open_events
from edslam_ti.geometry import orthonormalized
from edslam_ti.lenses import Undistortion
from edslam_ti.trajectory import in_order as poses_in_order

EVENT_FILES = "*_data.hdf5"
LEFT = "davis/left"
GRAVITY = 9.81  # m/s^2


class MvsecSequence(Recording):
    """A folder of MVSEC with one recording."""

    dataset = "mvsec"

    def __init__(self, folder: Path, needs_depth: bool = True) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: sequence folder not found")
        event_file = only_file(folder, EVENT_FILES, "events")
        name = event_file.name.removesuffix("_data.hdf5")
        path = _calibration_file(folder, name)
        values = read_yaml(path)
        if not isinstance(values, dict) or not isinstance(values.get("cam0"), dict):
            raise DataError(f"{path}: expected a Kalibr camchain with cam0")
        lens = kalibr_lens(values["cam0"], f"{path}: cam0")
        truth_file = folder / f"{name}_gt.hdf5"
        truth = Hdf5File(truth_file) if truth_file.is_file() else None
        rectified = _rectified(values["cam0"], lens.pinhole, path)
        if truth is None or f"{LEFT}/depth_image_rect" not in truth:
            rectified = None
        camera, R = rectified or (lens.best_fit, np.eye(3))
        events = open_events(event_file, (camera.width, camera.height), group="left")
        super().__init__(folder, events, Undistortion(lens, camera, R), "MVSEC")
        data = Hdf5File(event_file)
        if f"{LEFT}/image_raw" in data:
            times = data.times(f"{LEFT}/image_raw_ts", 1.0)
            self.set_images(times, lambda k: self._grey(data, k), "image_raw_ts")
        if f"{LEFT}/imu" in data:
            self._find_imu(data)
        if truth is not None:
            self._find_truth(truth, R, rectified is not None)
        self.finish(needs_depth, f"no depth: expected {name}_gt.hdf5 with {LEFT}/depth_image_rect or _raw")

    def _grey(self, data: Hdf5File, index: int) -> np.ndarray:  # [H, W] float32 in [0, 1]
        raw = data.read(f"{LEFT}/image_raw", index).astype(np.float32) / 255
        if raw.shape != self._undistortion.lens.pinhole.shape:
            raise DataError(f"{data.path}: image_raw: expected the camera's size, got {raw.shape}")
        return self._undistortion.image(raw)

    def _find_imu(self, data: Hdf5File) -> None:
        """Keep the IMU's six columns; the three whose length is gravity's are the acceleration."""
        rows = data.read(f"{LEFT}/imu").astype(np.float64)
        if rows.ndim != 2 or rows.shape[1] != 6:
            raise DataError(f"{data.path}: {LEFT}/imu: expected [N, 6], got {rows.shape}")
        first, second = rows[:, :3], rows[:, 3:]
        off = [abs(np.median(np.linalg.norm(part, axis=1)) - GRAVITY) for part in (first, second)]
        acceleration, rate = (first, second) if off[0] <= off[1] else (second, first)
        self.set_imu(in_order(data.read(f"{LEFT}/imu_ts").astype(np.float64), rate, acceleration), "imu_ts")

    def _find_truth(self, truth: Hdf5File, R: np.ndarray, is_rectified: bool) -> None:
        place = f"{LEFT}/depth_image_{'rect' if is_rectified else 'raw'}"
        undistortion, sensor = self._undistortion, self._undistortion.lens.pinhole
        if place in truth:
            times = truth.times(f"{place}_ts", 1.0)
            if is_rectified:
                self.set_depth(times, lambda k: truth.depth(place, k, self.camera), f"{place}_ts")
            else:
                self.set_depth(
                    times, lambda k: undistortion.depth(truth.depth(place, k, sensor)), f"{place}_ts"
                )
        if f"{LEFT}/pose" in truth:
            poses = truth.read(f"{LEFT}/pose").astype(np.float64)
            times = truth.read(f"{LEFT}/pose_ts").astype(np.float64)
            rows = np.arange(len(poses))
            check_rigid(poses, truth.path, rows)
            path, notes = poses_in_order(
                times, np.array([orthonormalized(T) for T in poses]), rows, truth.path
            )
            self.notes.extend(notes)
            T_camera_rectified = np.eye(4)
            T_camera_rectified[:3, :3] = R.T
            self.set_truth(path, "pose_ts", T_camera_rectified)


def _rectified(values: dict[str, Any], sensor: Camera, path: Path) -> tuple[Camera, np.ndarray] | None:
    """Return the rectified camera and the rotation to it, None where the file does not state them."""
    if "projection_matrix" not in values:
        return None
    P = numbers(values["projection_matrix"], 12, f"{path}: projection_matrix").reshape(3, 4)
    R = numbers(values.get("rectification_matrix", np.eye(3)), 9, f"{path}: rectification_matrix").reshape(
        3, 3
    )
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3:
        raise DataError(f"{path}: rectification_matrix: expected a rotation, got {R.tolist()}")
    try:
        size = (sensor.width, sensor.height)
        return Camera(*size, float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2])), R
    except DataError as error:
        raise DataError(f"{path}: projection_matrix: {error}") from error


def _calibration_file(folder: Path, name: str) -> Path:
    """Return the camchain of a recording; of several, that of its scenario, as indoor_flying of 1 to 4."""
    scenario = name.rstrip("0123456789")
    for parent in (folder, folder.resolve().parent):
        found = sorted([*parent.glob("camchain*.yaml"), *parent.glob("*calib/camchain*.yaml")])
        matching = [p for p in found if scenario in p.name] or found
        if matching:
            return matching[0]
    raise FileNotFoundError(
        f"{folder}: calibration not found; expected {scenario}_calib/camchain-imucam-{scenario}.yaml, "
        "here or one folder up"
    )


def is_mvsec(folder: Path) -> bool:
    """Return whether a folder holds events where this layout has them."""
    return any(folder.glob(EVENT_FILES))
