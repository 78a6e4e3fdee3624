"""VECtor benchmark (Gao et al. 2022): Prophesee event camera, Azure Kinect, motion capture.

    <name>.synced.left_event.hdf5        DSEC's layout, 640x480, distorted
    <name>.synced.kinect_depth/<s>.png   16 bits, mm, 640x576, in the Kinect's own depth camera
    (or .left_event.bag, .kinect_depth.bag)
    <name>.synced.left_event_depth/<s>.png    mm, reprojected and undistorted (k4a_projector); used if
                                              there is no kinect_depth
    <name>.synced.left_camera/<s>.png, timestamp.txt    grey 1224x1024; start and end of exposure [s]
    <name>.synced.gt.txt                 TUM, T_world_body of the motion capture (large scale: of the lidar)
    <name>.synced.imu.txt                t gx gy gz ax ay az qx qy qz qw
    *.yaml                               calibration, here or in the folder above, or in a folder
                                         calibration or 0_calib of these

The Kinect sees from 9 cm beside the event camera. Its depth is drawn into the undistorted event camera, whose
intrinsics are the projection matrix of its calibration. The event camera's pose is
T_world_body T_body_grey T_grey_event. Grey images are those of another camera and are not used, except that
`crop` counts them: it leaves out the start, and often the end, as published evaluations do (DEVO, Klenk et
al. 2024).
"""

from pathlib import Path

from edslam_ti.datasets.bag_depth import depth_of_bag
from edslam_ti.datasets.depth import DepthFormat, read_depth
from edslam_ti.datasets.files import read_numbers, timed_files
from edslam_ti.datasets.imu import read_imu_text
from edslam_ti.datasets.recording import Recording
from edslam_ti.datasets.vector_calibration import BODY, DEPTH, EVENT, LIDAR, VectorCalibration
from edslam_ti.depth_reprojection import DepthReprojection
from edslam_ti.errors import DataError, plain
from edslam_ti.event_files import open_events
from edslam_ti.lenses import Undistortion
from edslam_ti.trajectory import read_tum

EVENT_FILES = ("*.synced.left_event.h*5", "*.synced.left_event.bag")
LARGE_SCALE = ("corridors", "units", "school")  # recorded with a lidar, without the Kinect
MILLIMETRES = DepthFormat(0.001)
HEADER_LINES = 2  # of text files
# First and last grey image that evaluations use (DEVO); None: to the end but for one image.
CROPS: dict[str, tuple[int, int | None]] = {
    "corner_slow": (30, 1180),
    "robot_normal": (40, None),
    "robot_fast": (30, 901),
    "desk_normal": (65, None),
    "desk_fast": (25, 1380),
    "sofa_normal": (120, 2700),
    "sofa_fast": (50, 1200),
    "mountain_normal": (40, None),
    "mountain_fast": (15, 1290),
    "hdr_normal": (30, None),
    "hdr_fast": (35, None),
    "corridors_dolly": (115, None),
    "school_dolly": (80, 3160),
    "units_scooter": (10, 2790),
}


class VectorSequence(Recording):
    """A folder of the VECtor benchmark."""

    dataset = "vector"

    def __init__(self, folder: Path, crop: bool = False, needs_depth: bool = True) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: sequence folder not found")
        event_file = _event_file(folder)
        name = event_file.name.split(".synced.")[0]
        is_large = name.startswith(LARGE_SCALE)
        calibration = VectorCalibration(folder, is_large)
        lens = calibration.lenses[EVENT]
        camera = calibration.projections.get(EVENT, lens.best_fit)
        size = (lens.pinhole.width, lens.pinhole.height)
        super().__init__(folder, open_events(event_file, size), Undistortion(lens, camera), "VECtor")
        if calibration.published:
            self.description += (
                f"; published calibration, because no file states it: {', '.join(calibration.published)}"
            )
        if crop:
            self._crop(name)
        self._find_depth(name, calibration, is_large)
        truth_file = folder / f"{name}.synced.gt.txt"
        if truth_file.is_file():
            carrier = LIDAR if is_large else BODY
            self.set_truth(
                read_tum(truth_file, self.notes, HEADER_LINES),
                truth_file.name,
                calibration.between(carrier, EVENT),
            )
        imu_file = folder / f"{name}.synced.imu.txt"
        if imu_file.is_file():
            self.set_imu(read_imu_text(imu_file, 11, "t gx gy gz ax ay az qx qy qz qw"), imu_file.name)
        self.finish(
            needs_depth,
            "no depth: the large-scale recordings were made without the Kinect"
            if is_large
            else f"no depth found; expected {name}.synced.kinect_depth/<seconds>.png or "
            f"{name}.synced.left_event_depth",
        )

    def _find_depth(self, name: str, calibration: VectorCalibration, is_large: bool) -> None:
        raw, drawn = (self._folder / f"{name}.synced.{kind}" for kind in ("kinect_depth", "left_event_depth"))
        times, files = timed_files(raw, (".png",))
        bag = raw.with_name(f"{raw.name}.bag")
        if not files and not is_large and bag.is_file():
            times, files = depth_of_bag(bag, "/kinect/depth_image")
        if files and not is_large:
            lens = calibration.lenses[DEPTH]
            reprojection = DepthReprojection(lens, self.camera, calibration.between(EVENT, DEPTH))
            self.set_depth(
                times, lambda k: reprojection(read_depth(files[k], lens.pinhole, MILLIMETRES)), raw.name
            )
            return
        times, others = timed_files(drawn, (".png",))
        if others:
            self.note(f"{drawn.name}: depth as k4a_projector drew it; {raw.name} is not there")
            self.set_depth(times, lambda k: read_depth(others[k], self.camera, MILLIMETRES), drawn.name)

    def _crop(self, name: str) -> None:
        key = next((key for key in CROPS if name.replace("-", "_").startswith(key)), None)
        if key is None:
            known = ", ".join(CROPS)
            raise DataError(f"crop: expected one of {known}, got '{plain(name, 60)}'; leave it out")
        stamps = self._folder / f"{name}.synced.left_camera" / "timestamp.txt"
        exposures = read_numbers(stamps, 2, "start and end of an exposure [s]", HEADER_LINES).mean(1)
        start, stop = CROPS[key]
        last = len(exposures) - 2 if stop is None else min(stop, len(exposures)) - 1
        if last <= start:
            raise DataError(f"{stamps}: crop: expected more than {start + 1} images, got {len(exposures)}")
        self.crop(float(exposures[start]), float(exposures[last]))
        self.description += f", cropped to images {start} to {last} of left_camera"


def _event_file(folder: Path) -> Path:
    found = next((f for f in (sorted(folder.glob(pattern)) for pattern in EVENT_FILES) if f), [])
    if not found:
        raise FileNotFoundError(f"{folder}: no events found; expected <name>.synced.left_event.hdf5")
    if len(found) > 1:
        raise DataError(
            f"{folder}: expected one recording, got {found[0].name} and {found[1].name}; one folder each"
        )
    return found[0]


def is_vector(folder: Path) -> bool:
    """Return whether a folder holds events where this layout has them."""
    return any(any(folder.glob(pattern)) for pattern in EVENT_FILES)
