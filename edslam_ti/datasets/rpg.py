"""RPG Event Camera Dataset, text layout (Mueggler et al. 2017), with depth images added.

    events.txt          t [s] x y p{0,1}
    images.txt          t [s] path                       optional
    groundtruth.txt     t [s] tx ty tz qx qy qz qw       optional; T_world_camera
    calib.txt           fx fy cx cy k1 k2 p1 p2 k3       pixel centres at integers
    depth/*.png or derived_depth/*.png                   16 bits; the number in the name is the line (from 0)
                                                         of images.txt that holds its time

The dataset itself has no depth. Depth images must be undistorted, pixel for pixel in the camera of this
loader (K of calib.txt, no distortion), in 1/5000 m as in TUM RGB-D; a `camera.json` {"depth_scale": S} states
another unit. These conventions were checked on slider_depth by warping images with its `derived_depth` (plane
sweep, not sensor data) between the true poses: 1/5000 m fits (half and double are four times worse),
undistorted fits better than distorted, and the poses are camera-to-world in OpenCV axes (x to the right).

Events and images are undistorted here. Every undistorted pixel takes the events of the sensor pixel nearest
to its distorted position. So no pixel is left without events and none gets those of two sensor pixels, but an
event may be duplicated or dropped.
"""

from pathlib import Path

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import EventDepthSequence
from edslam_ti.datasets.camera_file import read_camera
from edslam_ti.datasets.clocks import check_clock, clock_offset, note_coverage
from edslam_ti.datasets.depth import look_at_images, read_depth
from edslam_ti.datasets.files import (
    first_image_size,
    numbered_files,
    read_image,
    read_numbers,
    read_timed_paths,
)
from edslam_ti.errors import DataError, plain
from edslam_ti.event_files.checked import EventFile
from edslam_ti.events import Events
from edslam_ti.lenses import Lens, Undistortion
from edslam_ti.trajectory import Trajectory, read_tum

TUM_DEPTH_SCALE = 5000.0  # PNG units per metre


class RpgSequence(EventDepthSequence):
    """A folder in the RPG Event Camera Dataset's text layout, undistorted."""

    dataset = "rpg"
    contrast_threshold = None

    def __init__(self, folder: Path, needs_depth: bool = True) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: sequence folder not found")
        self.scene = folder.name
        K = _calibration(folder / "calib.txt")
        image_times, image_files = read_timed_paths(folder / "images.txt", "which also give depth its times")
        depth, depth_folder = _depth_files(folder, len(image_times), needs_depth)
        width, height = first_image_size(image_files or list(depth.values()))
        try:
            self.camera = Camera(width, height, *(float(v) for v in K[:4]))
        except DataError as error:
            raise DataError(f"{folder / 'calib.txt'}: {error}") from error
        self._depth_files = list(depth.values())
        self._image_files = image_files
        measured = "measured" if depth_folder == "depth" else "derived from the true poses, not measured"
        self.description = f"RPG Event Camera Dataset layout, {plain(folder)}, undistorted; depth {measured}"
        self._depth_format = read_camera(folder / "camera.json").depth_format(TUM_DEPTH_SCALE)

        self._events = EventFile(folder / "events.txt", width, height, is_text=True)
        self.num_dropped_events = self._events.num_dropped
        for note in self._events.notes:
            self.note(f"{self._events.path}: {note}")
        self.time_offset = clock_offset(self._events.time_range[0])
        if self.time_offset:
            self._events = self._events.shifted(self.time_offset)
        self.image_timestamps = image_times - self.time_offset
        self.depth_timestamps = image_times[list(depth)] - self.time_offset
        check_clock(self, folder, "images.txt", self.image_timestamps)
        if depth:
            note_coverage(self)
        self.truth = None
        if (folder / "groundtruth.txt").exists():
            truth = read_tum(folder / "groundtruth.txt", self.notes)
            self.truth = Trajectory(truth.timestamps - self.time_offset, truth.poses)
            check_clock(self, folder, "groundtruth.txt", self.truth.timestamps)

        try:
            self._undistortion = Undistortion(Lens(self.camera, "plumb_bob", tuple(float(v) for v in K[4:])))
        except DataError as error:
            raise DataError(f"{folder / 'calib.txt'}: {error}") from error
        look_at_images(self, folder)

    @property
    def time_range(self) -> tuple[float, float]:
        return self._events.time_range

    def events(self, start: float, end: float) -> Events:
        return self._undistortion.events(self._events.between(start, end))

    def depth(self, index: int) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
        return read_depth(self._depth_files[index], self.camera, self._depth_format)

    def image(self, index: int) -> np.ndarray:  # [H, W] float32 in [0, 1]
        return self._undistortion.image(read_image(self._image_files[index], self.camera))


def _calibration(path: Path) -> np.ndarray:  # [9] fx fy cx cy k1 k2 p1 p2 k3
    rows = read_numbers(path, 9, "fx fy cx cy k1 k2 p1 p2 k3")
    if len(rows) > 1:
        raise DataError(f"{path}: expected one line of 9 numbers, got {len(rows)}; keep this camera's")
    return np.asarray(rows[0])


def _depth_files(folder: Path, num_times: int, needs_depth: bool) -> tuple[dict[int, Path], str]:
    """Return the depth images by the index of their time, and the name of their folder."""
    for name in ("depth", "derived_depth"):
        files = numbered_files(folder / name, "*", (".png",))
        if files and max(files) >= num_times:
            raise DataError(
                f"{files[max(files)]}: images.txt has only {num_times} lines; expected the number in the "
                "name to be the line (from 0) with the depth image's time"
            )
        if files:
            return files, name
    if not needs_depth:
        return {}, "depth"
    raise DataError(
        f"{folder}: no depth found; expected depth/*.png or derived_depth/*.png (16 bits, undistorted, "
        "numbered as the lines of images.txt), or --depth-dir FOLDER"
    )


def is_rpg(folder: Path) -> bool:
    """Return whether a folder holds events where this layout has them."""
    is_generic = (folder / "depth.txt").is_file() and not (folder / "calib.txt").is_file()
    return (folder / "events.txt").is_file() and not is_generic
