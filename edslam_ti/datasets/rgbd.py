"""Recordings of depth cameras without events, in three published layouts.

TUM RGB-D (Sturm et al. 2012):

    depth.txt, rgb.txt     t [s] path, '#' comments
    groundtruth.txt        t [s] tx ty tz qx qy qz qw       optional; T_world_camera
    depth/*.png            16 bits, 1/5000 m, registered to the colour image

Replica as NICE-SLAM rendered it (Zhu et al. 2022):

    results/depthNNNNNN.png, results/frameNNNNNN.jpg        numbered from 0
    traj.txt               16 numbers a line, T_world_camera of frame 0, 1, ...
    ../cam_params.json     {"camera": {w, h, fx, fy, cx, cy, scale}}; may also lie in the folder itself

7-Scenes (Shotton et al. 2013) and 3DMatch (Zeng et al. 2017), one folder a sequence:

    [frames/]frame-NNNNNN.depth.png, .color.{png,jpg}, .pose.txt      16 bits, 1/1000 m; T_world_camera
    camera-intrinsics.txt  3x3 matrix K; may also lie in the folder above

Poses and images are optional, depth is not. A `camera.json` (camera_file.py) may state the camera (all of
width, height, fx, fy, cx, cy; pixel centres at integers unless it says "half"), `depth_scale`, `invalid` and
`frame_rate` (default 30 Hz, if files have numbers and no times).

TUM's folders do not state the camera. `freiburg1`, 2 or 3 in the folder's name selects the published one, and
images and depth are undistorted with it. TUM's depth and colour are not taken at the same time. Each depth
image gets the nearest colour image within `MAX_DIFFERENCE`; each colour image is used once, and counts as
taken at the time of the depth.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import EventDepthSequence
from edslam_ti.datasets.camera_file import CameraFile, read_camera, read_json
from edslam_ti.datasets.clocks import check_clock, clock_offset
from edslam_ti.datasets.depth import DepthFormat, look_at_images, read_depth
from edslam_ti.datasets.files import (
    first_image_size,
    numbered_files,
    read_image,
    read_numbers,
    read_timed_paths,
)
from edslam_ti.datasets.truth import MATRIX, check_rigid, read_poses
from edslam_ti.errors import DataError, plain
from edslam_ti.events import Events
from edslam_ti.geometry import orthonormalized
from edslam_ti.lenses import Lens, Undistortion
from edslam_ti.trajectory import Trajectory, read_tum

MAX_DIFFERENCE = 0.02  # s between depth and its colour image (associate.py of the TUM benchmark)
TUM_SCALE, MILLIMETRES = 5000.0, 1000.0  # PNG units in a metre
INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")
# From the TUM benchmark's page: fx, fy, cx, cy for 640x480 pixels, then distortion k1, k2, p1, p2, k3.
FREIBURG = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}


@dataclass(frozen=True)
class _Recording:
    """Contents of a layout's files."""

    camera: Camera
    depth_format: DepthFormat
    depth_files: list[Path]
    depth_times: np.ndarray  # [D] s, strictly increasing
    image_files: list[Path]
    image_times: np.ndarray  # [I] s, strictly increasing
    truth: Trajectory | None
    notes: tuple[str, ...] = ()  # repairs of the files
    lens: Lens | None = None  # of images and depth; None: undistorted


class RgbdSequence(EventDepthSequence):
    """A folder in one of the layouts; it has no events."""

    dataset = "rgbd"
    contrast_threshold = None
    has_events = False

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: sequence folder not found")
        self.scene = folder.name
        layout = next((name for name, layout in LAYOUTS.items() if layout.detect(folder)), None)
        if layout is None:
            expected = " or ".join(f"{layout.files} ({name})" for name, layout in LAYOUTS.items())
            raise DataError(f"{folder}: no depth found; expected {expected}")
        recording = LAYOUTS[layout].read(folder)
        self.camera, self.description = recording.camera, f"{layout} layout, {plain(folder)}, no events"
        self._depth_files, self._image_files = recording.depth_files, recording.image_files
        self._depth_format = recording.depth_format
        self.time_offset = clock_offset(float(recording.depth_times[0]))
        self.depth_timestamps = recording.depth_times - self.time_offset
        self.image_timestamps = recording.image_times - self.time_offset
        for text in recording.notes:
            self.note(text)
        self.truth = None
        if recording.truth is not None:
            self.truth = Trajectory(recording.truth.timestamps - self.time_offset, recording.truth.poses)
            check_clock(self, folder, "the file of poses", self.truth.timestamps)
        self._undistortion = None
        if recording.lens is not None and recording.lens.is_distorted:
            self._undistortion = Undistortion(recording.lens)
        look_at_images(self, folder)  # find faults now, not in the middle of a run

    @property
    def time_range(self) -> tuple[float, float]:
        return float(self.depth_timestamps[0]), float(self.depth_timestamps[-1])

    def events(self, start: float, end: float) -> Events:
        return Events.empty()

    def depth(self, index: int) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
        depth = read_depth(self._depth_files[index], self.camera, self._depth_format)
        return depth if self._undistortion is None else self._undistortion.depth(depth)

    def image(self, index: int) -> np.ndarray:  # [H, W] float32 in [0, 1]
        image = read_image(self._image_files[index], self.camera)
        return image if self._undistortion is None else self._undistortion.image(image)


def is_rgbd(folder: Path) -> bool:
    """Return whether a folder holds depth images where one of the layouts has them."""
    return any(layout.detect(folder) for layout in LAYOUTS.values())


# --- TUM RGB-D ---


def _is_tum(folder: Path) -> bool:
    return (folder / "depth.txt").is_file() and (folder / "rgb.txt").is_file()


def _read_tum(folder: Path) -> _Recording:
    depth_times, depth_files = read_timed_paths(folder / "depth.txt")
    image_times, image_files = read_timed_paths(folder / "rgb.txt")
    partners = associated(depth_times, image_times, MAX_DIFFERENCE)
    if not partners:
        raise DataError(
            f"{folder}: expected colour within {MAX_DIFFERENCE} s of depth, got none; rgb.txt covers "
            f"{image_times[0]:.3f} to {image_times[-1]:.3f} s, depth.txt {depth_times[0]:.3f} to "
            f"{depth_times[-1]:.3f} s"
        )
    stated = read_camera(folder / "camera.json")
    camera = _stated_camera(folder, stated)
    lens = _stated_lens(camera, stated) if camera is not None else _freiburg_lens(folder)
    notes: list[str] = []
    truth_file = folder / "groundtruth.txt"
    truth = read_tum(truth_file, notes) if truth_file.is_file() else None
    return _Recording(
        lens.pinhole,
        stated.depth_format(TUM_SCALE),
        depth_files,
        depth_times,
        [image_files[k] for k in partners.values()],
        depth_times[list(partners)],
        truth,
        tuple(notes),
        lens,
    )


def associated(
    first: np.ndarray,  # [A] s, increasing
    second: np.ndarray,  # [B] s, increasing
    max_difference: float,  # s
) -> dict[int, int]:
    """Return the index in `second` for each time in `first` that has a partner; nearest pairs match first.

    No time is used twice (associate.py of the TUM benchmark).
    """
    low, high = (np.searchsorted(second, first + d) for d in (-max_difference, max_difference))
    pairs = [(abs(first[i] - second[j]), i, j) for i in range(len(first)) for j in range(low[i], high[i])]
    partners: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in sorted(pairs):
        if i not in partners and j not in taken:
            partners[i] = j
            taken.add(j)
    return dict(sorted(partners.items()))


def _freiburg_lens(folder: Path) -> Lens:
    """Return the published camera of a TUM sequence, identified by its name."""
    name = re.search(r"f(?:reiburg|r)([123])(?!\d)", folder.resolve().name)
    if name is None:
        raise DataError(
            f"{folder}: TUM RGB-D folders do not state their camera; expected freiburg1, 2 or 3 in the "
            f"folder's name, or camera.json with {', '.join(INTRINSICS)}"
        )
    intrinsics, distortion = FREIBURG[name[1]]
    return Lens(Camera(640, 480, *intrinsics), "plumb_bob", distortion)


# --- Replica as NICE-SLAM rendered it ---


def _is_replica(folder: Path) -> bool:
    return any((folder / "results").glob("depth*.png"))


def _read_replica(folder: Path) -> _Recording:
    results = folder / "results"
    stated = read_camera(folder / "camera.json")
    camera, depth_format = _stated_camera(folder, stated), stated.depth_format()
    if camera is None or "depth_scale" not in stated.model_fields_set:
        published, units_per_metre = _replica_camera(folder)
        camera, depth_format = camera or published, stated.depth_format(units_per_metre)
    depth = numbered_files(results, "depth*", (".png",))
    images = _numbered(results, "frame*", (".jpg", ".jpeg", ".png"))
    truth = None
    if (folder / "traj.txt").is_file():
        poses = _poses(folder / "traj.txt")
        if max(depth) >= len(poses):
            raise DataError(
                f"{folder / 'traj.txt'}: expected a pose for every frame, line 1 for frame 0, got "
                f"{len(poses)} lines and {depth[max(depth)].name}"
            )
        truth = Trajectory(np.arange(len(poses)) / stated.frame_rate, poses)
    return _Recording(
        camera,
        depth_format,
        *_with_times(depth, stated),
        *_with_times(images, stated),
        truth,
        lens=_stated_lens(camera, stated),
    )


def _replica_camera(folder: Path) -> tuple[Camera, float]:
    """Return the camera of cam_params.json and the depth PNG units per metre."""
    places = [parent / "cam_params.json" for parent in (folder, folder.resolve().parent)]
    path = next((p for p in places if p.is_file()), None)
    if path is None:
        raise FileNotFoundError(
            f"{places[1]} not found; expected NICE-SLAM's cam_params.json there or in the sequence's folder"
        )
    try:
        values = read_json(path)["camera"]
        w, h, fx, fy, cx, cy, scale = (float(values[k]) for k in ("w", "h", "fx", "fy", "cx", "cy", "scale"))
        size = round(w), round(h)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(
            f'{path}: expected {{"camera": {{w, h, fx, fy, cx, cy, scale}}}}; {type(error).__name__}: '
            f"{plain(error)}"
        ) from error
    if not 1e-6 <= scale <= 1e6:
        raise DataError(f"{path}: scale: expected depth units in a metre, 1e-6 to 1e6, got {scale:g}")
    return Camera(*size, fx, fy, cx, cy), scale


# --- 7-Scenes and 3DMatch ---


def _frames_folder(folder: Path) -> Path:
    return folder / "frames" if (folder / "frames").is_dir() else folder


def _is_frames(folder: Path) -> bool:
    return any(_frames_folder(folder).glob("*.depth.png"))


def _read_frames(folder: Path) -> _Recording:
    frames = _frames_folder(folder)
    stated = read_camera(folder / "camera.json")
    depth = numbered_files(frames, "*.depth*", (".png",))
    images = _numbered(frames, "*.color*", (".png", ".jpg", ".jpeg"))
    camera = _stated_camera(folder, stated) or _matrix_camera(folder, list(depth.values()))
    truth = None
    pose_files = numbered_files(frames, "*.pose*", (".txt",))
    if pose_files:
        poses = np.concatenate([_poses(path) for path in pose_files.values()])
        truth = Trajectory(np.array(list(pose_files)) / stated.frame_rate, poses)
    return _Recording(
        camera,
        stated.depth_format(MILLIMETRES),
        *_with_times(depth, stated),
        *_with_times(images, stated),
        truth,
        lens=_stated_lens(camera, stated),
    )


def _matrix_camera(folder: Path, images: list[Path]) -> Camera:
    """Return the camera of camera-intrinsics.txt, with the size of the images."""
    places = [parent / "camera-intrinsics.txt" for parent in (folder, folder.resolve().parent)]
    path = next((p for p in places if p.is_file()), None)
    if path is None:
        raise FileNotFoundError(
            f"{places[0]} not found; expected the 3x3 matrix K (7-Scenes states 585 0 320, 0 585 240, "
            f"0 0 1), or camera.json with {', '.join(INTRINSICS)}"
        )
    K = read_numbers(path, 3, "a row of the 3x3 matrix K")
    zeros = () if K.shape != (3, 3) else (K[0, 1], K[1, 0], K[2, 0], K[2, 1], K[2, 2] - 1)
    if K.shape != (3, 3) or any(zeros):
        raise DataError(
            f"{path}: expected fx 0 cx, 0 fy cy, 0 0 1, got "
            f"{np.array2string(K.ravel(), max_line_width=10**6)}"
        )
    return Camera(*first_image_size(images), K[0, 0], K[1, 1], K[0, 2], K[1, 2])


# --- all layouts ---


def _stated_camera(folder: Path, stated: CameraFile) -> Camera | None:
    """Return the camera that camera.json states; None: it states none."""
    missing = [name for name in INTRINSICS if name not in stated.model_fields_set]
    if len(missing) == len(INTRINSICS):
        return None
    if missing:
        raise DataError(f"{folder / 'camera.json'}: expected all of {', '.join(INTRINSICS)}, or none of them")
    if "pixel_centres" in stated.model_fields_set:
        return stated.camera
    return Camera(*(getattr(stated, name) for name in INTRINSICS))


def _stated_lens(camera: Camera, stated: CameraFile) -> Lens:
    """Return a camera with the distortion that camera.json states, usually none."""
    return Lens(camera, stated.lens.model, stated.lens.coefficients)


def _numbered(folder: Path, pattern: str, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Return the files of a pattern by their number; empty if there are none."""
    return numbered_files(folder, pattern, suffixes) if any(folder.glob(pattern)) else {}


def _with_times(files: dict[int, Path], stated: CameraFile) -> tuple[list[Path], np.ndarray]:
    """Return the files and their times (s), from the numbers in their names."""
    return list(files.values()), np.array(list(files)) / stated.frame_rate


def _poses(path: Path) -> np.ndarray:  # [F, 4, 4]
    """Return the poses of a file: 16 numbers a line, or one matrix in 4 lines of 4."""
    if path.name == "traj.txt":
        return read_poses(path)[0]
    rows = read_numbers(path, 4, MATRIX)
    if len(rows) != 4:
        raise DataError(f"{path}: expected a 4x4 matrix T_world_camera, got {len(rows)} rows of 4")
    poses = rows.reshape(-1, 4, 4)
    check_rigid(poses, path, np.array([1]))
    return np.array([orthonormalized(T) for T in poses])


@dataclass(frozen=True)
class _Layout:
    """An arrangement of depth images and related files in a folder."""

    files: str  # its distinctive files, for messages
    detect: Callable[[Path], bool]
    read: Callable[[Path], _Recording]


LAYOUTS = {
    "TUM RGB-D": _Layout("depth.txt and rgb.txt", _is_tum, _read_tum),
    "NICE-SLAM Replica": _Layout("results/depthNNNNNN.png", _is_replica, _read_replica),
    "7-Scenes": _Layout("frame-NNNNNN.depth.png", _is_frames, _read_frames),
}
