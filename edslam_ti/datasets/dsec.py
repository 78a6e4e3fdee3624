"""DSEC (Gehrig et al. 2021): stereo event cameras on a car, depth as disparity of a lidar.

    events/left/events.h5                    640x480, distorted
    disparity/event/NNNNNN.png               16 bits, 1/256 px, rectified left event camera, 0 = missing
    disparity/timestamps.txt                 us, one a line, in the order of the files
    calibration/cam_to_cam.yaml              intrinsics cam0, camRect0; extrinsics R_rect0;
                                             disparity_to_depth cams_03 (Q)
    groundtruth.txt                          optional; TUM, T_world_camera of the rectified left event camera

Events are rectified (undistorted and turned), so that they are in the camera of the disparity. With
[X Y Z W] = Q [u v d 1], depth is Z / W. The data set itself has no true poses.
"""

from pathlib import Path

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.calibration import lens_of, numbers, read_yaml
from edslam_ti.datasets.depth import FARTHEST_DEPTH
from edslam_ti.datasets.files import decode, numbered_files, read_numbers
from edslam_ti.datasets.recording import Recording
from edslam_ti.errors import DataError
from edslam_ti.event_files import open_events
from edslam_ti.lenses import Lens, Undistortion
from edslam_ti.trajectory import read_tum

EVENT_FILES = ("events/left/events.h5", "events_left/events.h5", "left/events.h5")
DISPARITIES_PER_PIXEL = 256.0
MICROSECONDS = 1e6


class DsecSequence(Recording):
    """A folder of DSEC."""

    dataset = "dsec"

    def __init__(self, folder: Path, needs_depth: bool = True) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: sequence folder not found")
        path = next(
            (p for p in (folder / "calibration/cam_to_cam.yaml", folder / "cam_to_cam.yaml") if p.is_file()),
            None,
        )
        if path is None:
            raise FileNotFoundError(
                f"{folder}: calibration/cam_to_cam.yaml not found (train_calibration.zip)"
            )
        lens, camera, R, Q = _calibration(path)
        event_file = next((folder / name for name in EVENT_FILES if (folder / name).is_file()), None)
        if event_file is None:
            raise FileNotFoundError(
                f"{folder}: no events found; expected {EVENT_FILES[0]} (train_events.zip)"
            )
        events = open_events(event_file, (lens.pinhole.width, lens.pinhole.height))
        super().__init__(folder, events, Undistortion(lens, camera, R), "DSEC")
        disparity = numbered_files(folder / "disparity/event", "*", (".png",))
        if disparity:
            times = read_numbers(folder / "disparity/timestamps.txt", 1, "time [us]")[:, 0] / MICROSECONDS
            files = list(disparity.values())
            if len(times) != len(files):
                raise DataError(
                    f"{folder}: expected a time for each disparity image, got {len(times)} times and "
                    f"{len(files)} files"
                )
            self.set_depth(times, lambda k: _depth(files[k], camera, Q), "disparity/timestamps.txt")
        if (folder / "groundtruth.txt").is_file():
            self.set_truth(read_tum(folder / "groundtruth.txt", self.notes), "groundtruth.txt")
        self.finish(needs_depth, "no depth: expected disparity/event/*.png (train_disparity.zip)")


def _calibration(path: Path) -> tuple[Lens, Camera, np.ndarray, np.ndarray]:  # R [3, 3], Q [4, 4]
    """Return the lens, the rectified camera, the rotation to it, and Q of cam_to_cam.yaml."""
    values = read_yaml(path)
    try:
        cam0, rectified = values["intrinsics"]["cam0"], values["intrinsics"]["camRect0"]
        R = numbers(values["extrinsics"]["R_rect0"], 9, f"{path}: R_rect0").reshape(3, 3)
        Q = numbers(values["disparity_to_depth"]["cams_03"], 16, f"{path}: cams_03").reshape(4, 4)
        size = numbers(cam0["resolution"], 2, f"{path}: cam0.resolution")
        K = numbers(cam0["camera_matrix"], 4, f"{path}: cam0.camera_matrix fx fy cx cy")
        K_rect = numbers(rectified["camera_matrix"], 4, f"{path}: camRect0.camera_matrix fx fy cx cy")
        D = numbers(cam0["distortion_coeffs"], (4, 5), f"{path}: cam0.distortion_coeffs")
    except (KeyError, TypeError) as error:
        raise DataError(
            f"{path}: expected intrinsics cam0 and camRect0, extrinsics R_rect0, disparity_to_depth cams_03; "
            f"missing {error}"
        ) from error
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or Q[3, 2] == 0:
        raise DataError(
            f"{path}: expected a rotation R_rect0 and Q with a baseline, got {R.tolist()} and {Q.tolist()}"
        )
    try:
        sensor = Camera(int(size[0]), int(size[1]), *(float(v) for v in K))
        camera = Camera(int(size[0]), int(size[1]), *(float(v) for v in K_rect))
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    return lens_of(str(cam0.get("distortion_model", "radtan")), D, sensor, str(path)), camera, R, Q


def _depth(path: Path, camera: Camera, Q: np.ndarray) -> np.ndarray:  # [H, W] float32 m, 0 = missing
    raw = decode(path, cv2.IMREAD_UNCHANGED, camera, "disparity")
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise DataError(f"{path}: expected a 16-bit single-channel PNG, got {raw.dtype} of shape {raw.shape}")
    disparity = raw.astype(np.float64) / DISPARITIES_PER_PIXEL
    w = Q[3, 2] * disparity + Q[3, 3]
    with np.errstate(divide="ignore"):
        depth = Q[2, 3] / w
    return np.where((raw > 0) & (depth > 0) & (depth < FARTHEST_DEPTH), depth, 0).astype(np.float32)


def is_dsec(folder: Path) -> bool:
    """Return whether a folder holds events where this layout has them."""
    return any((folder / name).is_file() for name in EVENT_FILES)
