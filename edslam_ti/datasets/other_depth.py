"""Depth images from another folder, for recordings without depth or with a better one.

    <time>.png or .exr     the time is the file's name (files.timed_files), on the recording's own clock; or
    timestamps.txt         lines 'name seconds' for files of any numbered names
    camera.json            optional (camera_file.py): depth_scale, invalid, and the depth camera (width,
                           height, fx, fy, cx, cy, distortion; pixel centres at integers unless it says
                           "half") with T_events_depth, 16 numbers: where it is in the event camera's frame

Without a stated camera, depth belongs to the undistorted event camera, pixel for pixel. With one it is drawn
into that camera.
"""

from pathlib import Path

import numpy as np

from edslam_ti.datasets.base import EventDepthSequence, WrappedSequence
from edslam_ti.datasets.calibration import rigid_motion
from edslam_ti.datasets.camera_file import CameraFile, read_camera
from edslam_ti.datasets.clocks import check_clock, note_coverage
from edslam_ti.datasets.depth import look_at_images, read_depth
from edslam_ti.datasets.files import numbered_files, read_timestamps, timed_files
from edslam_ti.depth_reprojection import DepthReprojection
from edslam_ti.errors import DataError, plain
from edslam_ti.lenses import Lens

SUFFIXES = (".png", ".exr")
INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")


class OtherDepth(WrappedSequence):
    """A recording with the depth images of another folder; the kernels must have been started."""

    def __init__(self, sequence: EventDepthSequence, folder: Path) -> None:
        super().__init__(sequence)
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: depth folder not found")
        times, self._files = _files(folder)
        if not self._files:
            raise DataError(
                f"{folder}: no depth found; expected <time>.png or .exr, or timestamps.txt beside them"
            )
        stated = read_camera(folder / "camera.json")
        self._format = stated.depth_format()
        lens = _lens(folder, stated)
        self._source, self._reprojection = self.camera, None
        if lens is not None:
            T = np.eye(4)
            if stated.T_events_depth is not None:
                T = rigid_motion(stated.T_events_depth, f"{folder / 'camera.json'}: T_events_depth")
            self._source, self._reprojection = lens.pinhole, DepthReprojection(lens, self.camera, T)
        self.depth_timestamps = times - self.time_offset
        self.description += f"; depth of {plain(folder)}"
        check_clock(self, folder, "depth", self.depth_timestamps)
        note_coverage(self)
        look_at_images(self, folder)

    def depth(self, index: int) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
        depth = read_depth(self._files[index], self._source, self._format)
        return depth if self._reprojection is None else self._reprojection(depth)


def _files(folder: Path) -> tuple[np.ndarray, list[Path]]:  # [D] s, D files
    stamps = folder / "timestamps.txt"
    if not stamps.is_file():
        return timed_files(folder, SUFFIXES)
    numbered = numbered_files(folder, "*", SUFFIXES)
    times = read_timestamps(stamps, numbered)
    order = np.argsort(times, kind="stable")
    files = list(numbered.values())
    if (np.diff(times[order]) <= 0).any():
        raise DataError(f"{stamps}: expected a time for each image, got one twice")
    return times[order], [files[k] for k in order]


def _lens(folder: Path, stated: CameraFile) -> Lens | None:
    """Return the depth camera; None: depth is in the event camera."""
    missing = [name for name in INTRINSICS if name not in stated.model_fields_set]
    if len(missing) == len(INTRINSICS):
        if stated.T_events_depth is not None:
            raise DataError(
                f"{folder / 'camera.json'}: T_events_depth: expected {', '.join(INTRINSICS)} with it"
            )
        return None
    if missing:
        raise DataError(f"{folder / 'camera.json'}: expected all of {', '.join(INTRINSICS)}, or none of them")
    if "pixel_centres" not in stated.model_fields_set:
        stated = stated.model_copy(update={"pixel_centres": "integer"})
    return stated.lens
