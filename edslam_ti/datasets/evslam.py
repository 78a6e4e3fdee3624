"""EvSLAM (Zhong et al. 2026): a pair of DVXplorers and a RealSense D435 on drone, arm, slider and car.

    <name>.bag                     one, here or in rosbag/: /dvxplorer_left/events (dvs_msgs/EventArray),
                                   /dvxplorer_left/imu, /camera/depth/image_rect_raw[/compressed]
    *calib_results_cam*.txt        Kalibr camchain with rostopic, T_cam_imu, timeshift_cam_imu of every camera
    <name>.tum, <name>_gt.txt      poses; optional

Calibration may lie in calibration/, poses in groundtruth/ or gt/, of this folder or of the one above, as the
published tree has them. The D435 computes depth in the frame of its left infrared camera. Stamps are moved to
the clock of the event camera by timeshift_cam_imu (t_imu = t_cam + shift). Published pages do not say which
frame the poses are of; they are taken as those of the left event camera.
"""

from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.datasets.bag_depth import depth_of_bag, depth_topic
from edslam_ti.datasets.calibration import kalibr_lens, read_yaml, rigid_motion
from edslam_ti.datasets.depth import DepthFormat, read_depth
from edslam_ti.datasets.imu import in_order
from edslam_ti.datasets.recording import Recording
from edslam_ti.depth_reprojection import DepthReprojection
from edslam_ti.errors import DataError
from edslam_ti.event_files import open_events
from edslam_ti.event_files.bags import bag_imu, bag_topics
from edslam_ti.geometry import inverse
from edslam_ti.lenses import Undistortion
from edslam_ti.trajectory import read_tum

EVENTS, IMU = "/dvxplorer_left/events", "/dvxplorer_left/imu"
INFRARED = "/camera/infra1/"  # depth is computed in this camera's frame
CALIBRATION = ("*calib_results_cam*.txt", "*calib_results_cam*.yaml", "*camchain*.yaml")
MILLIMETRES = DepthFormat(0.001)


class EvslamSequence(Recording):
    """A folder with one recording of EvSLAM."""

    dataset = "evslam"

    def __init__(self, folder: Path, needs_depth: bool = True) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: sequence folder not found")
        bags = _bags(folder)
        if len(bags) != 1:
            found = f"{bags[0].name} and {bags[1].name}" if bags else "none"
            raise DataError(f"{folder}: expected one bag, here or in rosbag/, got {found}; one folder each")
        calibration = _calibration_file(folder)
        if calibration is None:
            raise FileNotFoundError(
                f"{folder}: calibration/calib_results_cam.txt not found, here or one folder up"
            )
        cameras = _cameras(calibration)
        event = _camera(cameras, EVENTS, calibration)
        lens = kalibr_lens(event, f"{calibration}: {EVENTS}")
        size = (lens.pinhole.width, lens.pinhole.height)
        events = open_events(bags[0], size, group=EVENTS)
        super().__init__(folder, events, Undistortion(lens, lens.best_fit), "EvSLAM")
        topic = depth_topic(bags[0])
        if topic is not None:
            self._find_depth(bags[0], topic, event, _camera(cameras, INFRARED, calibration), calibration)
        truth = _truth_file(folder, bags[0].stem)
        if truth is not None:
            self.set_truth(read_tum(truth, self.notes), truth.name)
            self.note(f"{truth.name}: poses are taken as the left event camera's")
        if IMU in bag_topics(bags[0]):
            rows = list(bag_imu(bags[0], IMU))
            times, values = np.array([t for t, _ in rows]), np.array([v for _, v in rows])
            self.set_imu(in_order(times - _shift(event), values[:, :3], values[:, 3:]), IMU)
        self.finish(needs_depth, "no depth: expected /camera/depth/image_rect_raw in the bag")

    def _find_depth(
        self, bag: Path, topic: str, event: dict[str, Any], infrared: dict[str, Any], calibration: Path
    ) -> None:
        lens = kalibr_lens(infrared, f"{calibration}: {INFRARED}")
        T_event_imu, T_depth_imu = (
            rigid_motion(camera.get("T_cam_imu"), f"{calibration}: T_cam_imu") for camera in (event, infrared)
        )
        reprojection = DepthReprojection(lens, self.camera, T_event_imu @ inverse(T_depth_imu))
        times, files = depth_of_bag(bag, topic)
        self.set_depth(
            times + _shift(infrared) - _shift(event),
            lambda k: reprojection(read_depth(files[k], lens.pinhole, MILLIMETRES)),
            topic,
        )


def _cameras(path: Path) -> list[dict[str, Any]]:
    values = read_yaml(path)
    cameras = [v for v in values.values() if isinstance(v, dict)] if isinstance(values, dict) else []
    if not any("rostopic" in camera for camera in cameras):
        raise DataError(f"{path}: expected a Kalibr camchain, cam0: {{intrinsics, ..., rostopic}}")
    return cameras


def _camera(cameras: list[dict[str, Any]], topic: str, path: Path) -> dict[str, Any]:
    """Return the camera of a topic."""
    for camera in cameras:
        if topic in str(camera.get("rostopic", "")):
            return camera
    raise DataError(f"{path}: expected a camera with rostopic {topic}")


def _shift(camera: dict[str, Any]) -> float:  # s
    try:
        return float(camera.get("timeshift_cam_imu", 0.0))
    except (TypeError, ValueError):
        raise DataError("timeshift_cam_imu: expected a number of seconds") from None


def _bags(folder: Path) -> list[Path]:
    return sorted([*folder.glob("*.bag"), *folder.glob("rosbag/*.bag")])


def _near(folder: Path, names: tuple[str, ...]) -> list[Path]:
    """Return the folders where files beside a recording may lie."""
    return [parent / name for parent in (folder, folder.resolve().parent) for name in ("", *names)]


def _calibration_file(folder: Path) -> Path | None:
    for place in _near(folder, ("calibration",)):
        for pattern in CALIBRATION:
            found = sorted(place.glob(pattern))
            kind = "drone" if "drone" in folder.name else "others"
            matching = [path for path in found if kind in path.name] or found
            if matching:
                return matching[0]
    return None


def _truth_file(folder: Path, name: str) -> Path | None:
    places = _near(folder, ("groundtruth", "gt"))
    candidates = [place / file for place in places for file in (f"{name}.tum", f"{name}_gt.txt")]
    return next((path for path in candidates if path.is_file()), None)


def is_evslam(folder: Path) -> bool:
    """Return whether a folder holds a bag, and a calibration is where this layout has it."""
    return bool(_bags(folder)) and _calibration_file(folder) is not None
