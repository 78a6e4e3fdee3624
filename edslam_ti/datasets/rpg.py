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

import cv2
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
from edslam_ti.trajectory import Trajectory, read_tum

EVENTS_AT_ONCE = 1_000_000  # undistorting takes some 70 bytes per event, its result 13
TUM_DEPTH_SCALE = 5000.0  # PNG units per metre
LARGEST_DISTORTION = 1000  # coefficients of real lenses are below 10
LEAST_SEEN = 0.1  # share of the undistorted image that the sensor must see


class RpgSequence(EventDepthSequence):
    """A folder in the RPG Event Camera Dataset's text layout, undistorted."""

    dataset = "rpg"
    contrast_threshold = None

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: sequence folder not found")
        self.scene = folder.name
        K = _calibration(folder / "calib.txt")
        image_times, image_files = read_timed_paths(folder / "images.txt", "which also give depth its times")
        depth, depth_folder = _depth_files(folder, len(image_times))
        width, height = first_image_size(image_files or list(depth.values()))
        try:
            self.camera = Camera(width, height, *(float(v) for v in K[:4]))
        except DataError as error:
            raise DataError(f"{folder / 'calib.txt'}: {error}") from error
        self._distortion = K[4:]
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
        note_coverage(self)
        self.truth = None
        if (folder / "groundtruth.txt").exists():
            truth = read_tum(folder / "groundtruth.txt", self.notes)
            self.truth = Trajectory(truth.timestamps - self.time_offset, truth.poses)
            check_clock(self, folder, "groundtruth.txt", self.truth.timestamps)

        matrix = self.camera.matrix
        self._image_maps = cv2.initUndistortRectifyMap(
            matrix, self._distortion, np.eye(3), matrix, (width, height), cv2.CV_32FC1
        )
        self._undistortion = _EventUndistortion(*self._image_maps)
        if self._undistortion.share_seen < LEAST_SEEN:
            raise DataError(
                f"{folder / 'calib.txt'}: expected distortion k1 k2 p1 p2 k3 of a lens, got one that shows "
                f"{100 * self._undistortion.share_seen:.0f} % of the undistorted image: "
                f"{' '.join(f'{v:g}' for v in self._distortion)}"
            )
        look_at_images(self, folder)

    @property
    def time_range(self) -> tuple[float, float]:
        return self._events.time_range

    def events(self, start: float, end: float) -> Events:
        return self._undistortion(self._events.between(start, end))

    def depth(self, index: int) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
        return read_depth(self._depth_files[index], self.camera, self._depth_format)

    def image(self, index: int) -> np.ndarray:  # [H, W] float32 in [0, 1]
        raw = read_image(self._image_files[index], self.camera)
        return np.asarray(cv2.remap(raw, *self._image_maps, interpolation=cv2.INTER_LINEAR))


class _EventUndistortion:
    """Nearest-neighbour remapping of events, from each undistorted pixel to its sensor pixel.

    Moving every event to the nearest undistorted pixel instead would leave curves of pixels without events,
    and give others the events of two pixels, so that their brightness seems to change twice as much.
    """

    def __init__(
        self,
        u: np.ndarray,  # [H, W] float32, column where the sensor sees the undistorted pixel
        v: np.ndarray,  # [H, W] float32, row
    ) -> None:
        height, self._width = u.shape
        x, y = np.rint(u).astype(np.int64), np.rint(v).astype(np.int64)
        is_seen = ((x >= 0) & (x < self._width) & (y >= 0) & (y < height)).ravel()
        self.share_seen = float(is_seen.mean())  # of the undistorted pixels
        source = (y * self._width + x).ravel()
        order = np.argsort(source, kind="stable")
        self._targets = order[is_seen[order]]  # undistorted pixels, sorted by the sensor's pixel
        number = np.bincount(source[is_seen], minlength=height * self._width)
        self._first = np.append(0, np.cumsum(number))  # [H W + 1] first target of each sensor pixel

    def __call__(self, events: Events) -> Events:
        """Return the events as an undistorted camera would have sent them, in the same order."""
        return Events.concatenate([self._undistorted(piece) for piece in events.pieces(EVENTS_AT_ONCE)])

    def _undistorted(self, events: Events) -> Events:
        pixel = events.y.astype(np.int64) * self._width + events.x
        first, number = self._first[pixel], self._first[pixel + 1] - self._first[pixel]
        event = np.repeat(np.arange(len(pixel)), number)
        rank = np.arange(len(event)) - np.repeat(np.cumsum(number) - number, number)
        y, x = np.divmod(self._targets[first[event] + rank], self._width)
        return Events(x.astype(np.int16), y.astype(np.int16), events.t[event], events.polarity[event])


def _calibration(path: Path) -> np.ndarray:  # [9] fx fy cx cy k1 k2 p1 p2 k3
    rows = read_numbers(path, 9, "fx fy cx cy k1 k2 p1 p2 k3")
    if len(rows) > 1:
        raise DataError(f"{path}: expected one line of 9 numbers, got {len(rows)}; keep this camera's")
    if np.abs(rows[0, 4:]).max() > LARGEST_DISTORTION:
        raise DataError(
            f"{path}: expected distortion k1 k2 p1 p2 k3 within +-{LARGEST_DISTORTION}, got "
            f"{' '.join(f'{v:g}' for v in rows[0, 4:])}"
        )
    return np.asarray(rows[0])


def _depth_files(folder: Path, num_times: int) -> tuple[dict[int, Path], str]:
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
    raise DataError(
        f"{folder}: no depth found; expected depth/*.png or derived_depth/*.png (16 bits, undistorted, "
        "numbered as the lines of images.txt)"
    )


def is_rpg(folder: Path) -> bool:
    """Return whether a folder holds events where this layout has them."""
    is_generic = (folder / "depth.txt").is_file() and not (folder / "calib.txt").is_file()
    return (folder / "events.txt").is_file() and not is_generic
