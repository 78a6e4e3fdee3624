"""TUM-VIE (Klenk et al. 2021): stereo event cameras of 1280x720 pixels on a head, motion capture, no depth.

    <name>-events_left.h5                   distorted; stamps in us
    mocap_data.txt                          t [us] px py pz qx qy qz qw, T_world_marker; optional
    imu_data.txt                            t [us] gx gy gz ax ay az temperature; optional
    camera-calibrationA.json (or B)         value0: intrinsics (equidistant), resolution, T_imu_cam of the
                                            four cameras
    mocap-imu-calibrationA.json (or B)      value0: T_imu_marker

Text files may lie in a folder <name>-vi_gt_data (or any folder *vi_gt_data). Calibration may lie in the
folder above. If both A and B are there, the recording's name decides, as the data set's page says. The left
event camera is the third of the four; its pose is T_world_marker inv(T_imu_marker) T_imu_cam. Depth must come
from elsewhere: the frame cameras and the event cameras are stereo pairs, from which it can be computed.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.camera import Camera
from edslam_ti.datasets.calibration import lens_of
from edslam_ti.datasets.camera_file import read_json
from edslam_ti.datasets.hdf5 import only_file
from edslam_ti.datasets.imu import read_imu_text
from edslam_ti.datasets.recording import Recording
from edslam_ti.errors import DataError, plain
from edslam_ti.event_files import open_events
from edslam_ti.geometry import inverse
from edslam_ti.lenses import Lens, Undistortion
from edslam_ti.trajectory import Trajectory, read_tum

EVENT_FILES = "*events_left.h5"
LEFT_EVENT = 2  # of the cameras in the calibration
MICROSECONDS = 1e6
HEADER_LINES = 1  # of mocap_data.txt
# Recorded with calibration A (page of the data set); all others with B.
WITH_A = ("loop-floor", "mocap-desk", "skate-easy")


class TumVieSequence(Recording):
    """A folder of TUM-VIE."""

    dataset = "tum_vie"

    def __init__(self, folder: Path, needs_depth: bool = True) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: sequence folder not found")
        event_file = only_file(folder, EVENT_FILES, "events")
        calibration = _calibration_file(folder, "camera-calibration")
        if calibration is None:
            raise FileNotFoundError(
                f"{folder}: camera-calibrationA.json or B not found, here or one folder up"
            )
        lens, T_imu_camera = _left_event_camera(calibration)
        size = (lens.pinhole.width, lens.pinhole.height)
        super().__init__(folder, open_events(event_file, size), Undistortion(lens, lens.best_fit), "TUM-VIE")
        texts = [folder, *sorted(p for p in folder.glob("*vi_gt_data") if p.is_dir())]
        poses = next((p / "mocap_data.txt" for p in texts if (p / "mocap_data.txt").is_file()), None)
        markers = _calibration_file(folder, "mocap-imu-calibration")
        if poses is not None and markers is None:
            self.note(f"{poses.name} is not used: mocap-imu-calibrationA.json or B is not there")
        if poses is not None and markers is not None:
            truth = read_tum(poses, self.notes, HEADER_LINES)
            T_imu_marker = _motion(_value0(markers).get("T_imu_marker"), f"{markers}: T_imu_marker")
            truth = Trajectory(truth.timestamps / MICROSECONDS, truth.poses)
            self.set_truth(truth, poses.name, inverse(T_imu_marker) @ T_imu_camera)
        inertial = next((p / "imu_data.txt" for p in texts if (p / "imu_data.txt").is_file()), None)
        if inertial is not None:
            imu = read_imu_text(inertial, (7, 8), "t [us] gx gy gz ax ay az temperature", MICROSECONDS)
            self.set_imu(imu, inertial.name)
        self.finish(needs_depth, "no depth: TUM-VIE has none; compute it from its stereo images or events")


def _left_event_camera(path: Path) -> tuple[Lens, np.ndarray]:  # T_imu_camera [4, 4]
    values = _value0(path)
    try:
        entry = values["intrinsics"][LEFT_EVENT]
        k = {name: float(value) for name, value in entry["intrinsics"].items()}
        width, height = (int(n) for n in values["resolution"][LEFT_EVENT])
        camera = Camera(width, height, k["fx"], k["fy"], k["cx"], k["cy"])
        coefficients = np.array([k["k1"], k["k2"], k["k3"], k["k4"]])
        lens = lens_of(str(entry.get("camera_type", "kb4")), coefficients, camera, str(path))
        return lens, _motion(values["T_imu_cam"][LEFT_EVENT], f"{path}: T_imu_cam[{LEFT_EVENT}]")
    except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(
            f"{path}: expected value0 with intrinsics [fx fy cx cy k1 k2 k3 k4], resolution and T_imu_cam of "
            f"four cameras; {type(error).__name__}: {plain(error)}"
        ) from error


def _motion(value: Any, what: str) -> np.ndarray:  # [4, 4]
    try:
        p, q = ([float(value[a + b]) for b in axes] for a, axes in (("p", "xyz"), ("q", "xyzw")))
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{what}: expected px py pz qx qy qz qw; {type(error).__name__}: {plain(error)}"
        ) from error
    if not 0.9 < np.linalg.norm(q) < 1.1 or not np.isfinite(p).all():
        raise DataError(f"{what}: expected a unit quaternion qx qy qz qw, got {q}")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(q).as_matrix(), p
    return T


def _value0(path: Path) -> dict[str, Any]:
    values = read_json(path)
    if not isinstance(values, dict) or not isinstance(values.get("value0"), dict):
        raise DataError(f"{path}: expected an object value0")
    return dict(values["value0"])


def _calibration_file(folder: Path, stem: str) -> Path | None:
    """Return the file A or B that belongs to a recording, in its folder or the one above."""
    letter = "A" if any(name in folder.name.replace("_", "-") for name in WITH_A) else "B"
    for parent in (folder, folder.resolve().parent):
        found = sorted(parent.glob(f"{stem}*.json"))
        if len(found) > 1:
            found = [p for p in found if p.stem.endswith(letter)]
        if found:
            return found[0]
    return None


def is_tum_vie(folder: Path) -> bool:
    """Return whether a folder holds events where this layout has them."""
    return any(folder.glob(EVENT_FILES))
