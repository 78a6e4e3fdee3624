"""EventReplica's layout (IncEventGS): one folder of events, depth, and perhaps images and poses.

    poses_ts.txt                               one time a line, seconds            } both or neither
    traj.txt                                   16 numbers a line, T_world_camera   }
    images/frameNNNNNN.{jpg,png,exr}           grey or colour, optional; OpenEXR: brightness 0 to 1
    event_threshold_<C>/gray_events_data.npy   (N, 4): x, y, t [s], p
    depth/frameNNNNNN.png                      16 bits, 1/depth_scale metres, 0 = missing; or
    Depth_exr/*.exr                            metres (used when there is no depth/frame*.png)
    camera.json                                optional
    novel_views/{images,depth}/frameNNNNNN.png, novel_views/traj.txt
                                               novel views: true views near the path, optional
    surfaces.ply                               true surfaces, metres, optional

NNNNNN is the time in milliseconds, with any number of digits. If it is an index, the times are in
depth/timestamps.txt and images/timestamps.txt (lines 'number_or_name seconds'), or follow from a rate
(`depth_rate` and `image_rate`, Hz, of `camera.json` or of the constructor): image N is taken N / rate seconds
after 0, or after the first event if the events' clock does not start with the recording.

camera.json: see camera_file.py; for missing fields EventReplica's own camera applies. With centres at "half"
(EventReplica's, as cx = width / 2 shows) the first pixel is centred at (0.5, 0.5); the sequence's `camera`
has centres at integers. A camera with distortion (k1, k2, ... or `distortion` with `distortion_model`) is
undistorted with unchanged focal lengths: events, images, and depth unless `depth_undistorted`. Depth:
depth.py says which values count as missing.

Clock: the files' own, in seconds; a late one is shifted (clocks.py), and `time_offset` holds the shift.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from edslam_ti.datasets.base import EventDepthSequence, NovelView, stamp_text
from edslam_ti.datasets.camera_file import CameraFile, read_camera
from edslam_ti.datasets.clocks import check_clock, check_milliseconds, clock_offset, note_coverage
from edslam_ti.datasets.depth import look_at_images, read_depth
from edslam_ti.datasets.exr import read_grey
from edslam_ti.datasets.files import numbered_files, read_timestamps
from edslam_ti.datasets.novel_views import read_novel_views
from edslam_ti.datasets.truth import read_timed_poses
from edslam_ti.errors import DataError, plain
from edslam_ti.event_files.checked import EventFile
from edslam_ti.events import Events
from edslam_ti.lenses import Undistortion
from edslam_ti.trajectory import Trajectory

EVENTS = "gray_events_data.npy"
THRESHOLD = "event_threshold_"


class EventReplicaSequence(EventDepthSequence):
    """A folder in EventReplica's layout; any scene name works.

    If the folder holds events simulated with several thresholds, `contrast_threshold` chooses one.
    """

    dataset = "event_replica"

    def __init__(
        self,
        folder: Path,
        contrast_threshold: float | None = None,
        depth_rate: float | None = None,  # Hz; depth images are numbered by index
        image_rate: float | None = None,  # Hz; so are grey images
        needs_depth: bool = True,
    ) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: sequence folder not found")
        self.scene = folder.name
        self._folder = folder
        surfaces = folder / "surfaces.ply"
        self.surfaces_file = surfaces if surfaces.is_file() else None
        calibration = read_camera(folder / "camera.json")
        self.description = calibration.description or f"EventReplica layout, {plain(folder)}"
        self.camera = calibration.camera
        lens = calibration.lens
        try:
            self._undistortion = Undistortion(lens) if lens.is_distorted else None
        except DataError as error:
            raise DataError(f"{folder / 'camera.json'}: {error}") from error
        self._depth_is_undistorted = calibration.depth_undistorted
        self.exposure, self.preset = calibration.exposure, calibration.preset
        self._depth_format = calibration.depth_format()
        events_folder, self.contrast_threshold = _event_folder(
            folder, contrast_threshold, calibration.contrast_threshold
        )
        self._events = EventFile(events_folder / EVENTS, self.camera.width, self.camera.height)
        self.num_dropped_events = self._events.num_dropped
        for note in self._events.notes:
            self.note(f"{self._events.path}: {note}")

        self._shift = clock_offset(self._events.time_range[0])  # s, of the files' stamps
        self.time_offset = self._shift + calibration.time_offset
        if self._shift:
            self._events = self._events.shifted(self._shift)

        self._read_images(calibration, depth_rate, image_rate, needs_depth)
        self.truth = self._read_truth(folder)
        if self.truth is not None:
            check_clock(self, folder, "poses_ts.txt", self.truth.timestamps)
        look_at_images(self, folder)  # find faults now, not in the middle of a run

    @property
    def time_range(self) -> tuple[float, float]:
        return self._events.time_range

    def events(self, start: float, end: float) -> Events:
        events = self._events.between(start, end)
        return events if self._undistortion is None else self._undistortion.events(events)

    def depth(self, index: int) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
        return self._undistorted_depth(read_depth(self._depth_files[index], self.camera, self._depth_format))

    def image(self, index: int) -> np.ndarray:  # [H, W] float32 in [0, 1]
        return self._undistorted_image(read_grey(self._image_files[index], self.camera))

    def _undistorted_image(self, image: np.ndarray) -> np.ndarray:  # [H, W]
        return image if self._undistortion is None else self._undistortion.image(image)

    def _undistorted_depth(self, depth: np.ndarray) -> np.ndarray:  # [H, W] m
        if self._undistortion is None or self._depth_is_undistorted:
            return depth
        return self._undistortion.depth(depth)

    def novel_views(self) -> list[NovelView]:
        views = read_novel_views(self._folder, self.camera, self._depth_format, self._shift)
        return [
            replace(v, image=self._undistorted_image(v.image), depth=self._undistorted_depth(v.depth))
            for v in views
        ]

    def _read_images(
        self,
        calibration: CameraFile,
        depth_rate: float | None,
        image_rate: float | None,
        needs_depth: bool,
    ) -> None:
        """Find depth and grey images and their times."""
        depth_folder = self._folder / "depth"
        depth = numbered_files(depth_folder, "frame*", (".png",))
        if not depth:
            depth_folder = self._folder / "Depth_exr"
            depth = numbered_files(depth_folder, "*", (".exr",))
        if not depth and needs_depth:
            raise DataError(
                f"{self._folder}: no depth found; expected depth/frameNNNNNN.png (16 bits) or "
                "Depth_exr/*.exr with NNNNNN in milliseconds (EventReplica ships none: render at its poses)"
            )
        rate = depth_rate or calibration.depth_rate
        self._depth_files, self.depth_timestamps = self._with_times(depth_folder, depth, rate, "depth_rate")
        if depth:
            note_coverage(self)
        image_folder = self._folder / "images"
        images = numbered_files(image_folder, "frame*", (".jpg", ".jpeg", ".png", ".exr"))
        image_rate = image_rate or calibration.image_rate
        if rate and not image_rate and images and list(images) == list(depth):
            image_rate = rate
            self.note(f"{image_folder}: numbered like depth: assumed at the same rate, {rate:g} Hz")
        self._image_files, self.image_timestamps = self._with_times(
            image_folder, images, image_rate, "image_rate"
        )

    def _with_times(
        self, folder: Path, files: dict[int, Path], rate: float | None, key: str
    ) -> tuple[list[Path], np.ndarray]:
        """Return the files and their times (s): from timestamps.txt, a rate, or milliseconds in names."""
        numbers, offset = list(files), int(self._shift)
        name = f"{folder.name} (ms in the file names)"
        if (folder / "timestamps.txt").is_file():
            name = f"{folder.name}/timestamps.txt"
            times = read_timestamps(folder / "timestamps.txt", files) - self._shift
        elif rate:
            name = f"{folder.name} (at {rate:g} Hz)"
            first = self.time_range[0]
            origin = 0.0 if 0 <= first < 1 and not offset else first  # clocks start at 0, or with the events
            times = np.array([origin + number / rate for number in numbers])
        else:
            times = np.array([(number - 1000 * offset) / 1000 for number in numbers])
            check_milliseconds(self, folder, numbers, key)
        order = np.argsort(times, kind="stable")
        times, ordered = times[order], [list(files.values())[k] for k in order]
        if (np.diff(times) <= 0).any():
            k = int((np.diff(times) <= 0).argmax())
            raise DataError(
                f"{folder}: expected a time for each image, got {stamp_text(self, times[k])} s for both "
                f"{ordered[k].name} and {ordered[k + 1].name}"
            )
        check_clock(self, self._folder, name, times)
        return ordered, times

    def _read_truth(self, folder: Path) -> Trajectory | None:
        times_file, poses_file = folder / "poses_ts.txt", folder / "traj.txt"
        if not times_file.exists() and not poses_file.exists():
            return None
        if not (times_file.exists() and poses_file.exists()):
            present, missing = (times_file, poses_file) if times_file.exists() else (poses_file, times_file)
            raise DataError(
                f"{folder}: {present.name} is there but {missing.name} is not; expected both or neither"
            )
        truth, notes = read_timed_poses(times_file, poses_file)
        for text in notes:
            self.note(text)
        return Trajectory(truth.timestamps - self._shift, truth.poses)


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
