"""Event cameras and depth cameras on this machine, by their drivers from PyPI.

Written against the documented interfaces of neuromorphic-drivers 0.18 (Prophesee EVK3 and EVK4, SilkyEvCam,
DAVIS346, DVXplorer) and of pyrealsense2 2.5x. Tested with stand-ins that have the same interface; NOT TRIED
WITH HARDWARE. `pip install 'edslam-ti[cameras]'` brings both.

Neither camera knows the other's clock. Depth stamps are those of the computer's clock (RealSense's global
time), and every packet of events comes with the computer's time of arrival: the smallest difference of the
last seconds is taken for that of the clocks. That is right within a few milliseconds. Depth is drawn into the
event camera by T_events_depth, from the file of the event camera.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.calibration import rigid_motion
from edslam_ti.datasets.camera_file import read_json
from edslam_ti.depth_reprojection import DepthReprojection
from edslam_ti.errors import DataError, MissingExtraError, plain
from edslam_ti.lenses import Lens, model_name
from edslam_ti.live.items import CameraItem, DepthItem, EventsItem, ImageItem, Item, NoteItem
from edslam_ti.live.messages import camera_item

TIMEOUT = 0.05  # seconds that drivers wait for data
OFFSETS = 10  # seconds whose smallest delay counts
WAITING_DEPTH = 16  # depth images that wait for the difference of the clocks; more are dropped
DAVIS_WHITE = 65472.0  # largest value of a DAVIS346's pixel


def load_driver(name: str) -> ModuleType:
    """Return a driver's module; raises MissingExtraError where it is not installed."""
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingExtraError(
            f"{name}: not installed, or not for this machine ({plain(error)}); "
            "pip install 'edslam-ti[cameras]'"
        ) from error


class ClockDifference:
    """The computer's clock minus a camera's, from the moments at which packets arrive."""

    def __init__(self) -> None:
        self._smallest: deque[tuple[int, float]] = deque(maxlen=OFFSETS)  # second, difference in s

    def add(self, arrival: float, stamp: float) -> None:
        """Note a packet whose newest datum has a stamp (s) of the camera; arrival by the computer's clock."""
        second, difference = int(arrival), arrival - stamp
        if self._smallest and self._smallest[-1][0] == second:
            difference = min(difference, self._smallest.pop()[1])
        self._smallest.append((second, difference))

    @property
    def seconds(self) -> float | None:
        """The difference; None before the first packet."""
        return min((difference for _, difference in self._smallest), default=None)


class RealsenseDepth:
    """A depth camera of RealSense; hands over images in metres with stamps of the computer's clock."""

    def __init__(self, driver: Any) -> None:  # the module pyrealsense2
        """Start the camera; raises DataError where there is none."""
        self._driver = driver
        self._pipeline = driver.pipeline()
        try:
            profile = self._pipeline.start()
        except RuntimeError as error:
            raise DataError(f"RealSense: {plain(error)}; is the camera connected?") from error
        stream = profile.get_stream(driver.stream.depth).as_video_stream_profile()
        self.lens = _realsense_lens(stream.get_intrinsics())

    def images(self, is_closed: threading.Event) -> Iterator[tuple[float, np.ndarray]]:
        """Yield stamps (s, computer's clock) and depth [h, w] in metres, until it is closed."""
        while not is_closed.is_set():
            has_come, frames = self._pipeline.try_wait_for_frames(int(1000 * TIMEOUT))
            depth = frames.get_depth_frame() if has_come else None
            if not depth:
                continue
            if depth.get_frame_timestamp_domain() == self._driver.timestamp_domain.hardware_clock:
                raise DataError(
                    "RealSense: expected stamps of the computer's clock (global time), got the camera's"
                )
            units = np.asanyarray(depth.get_data()).astype(np.float32)
            yield depth.get_timestamp() / 1000, units * np.float32(depth.get_units())

    def close(self) -> None:
        """Stop the camera."""
        self._pipeline.stop()


class CameraSource:
    """An event camera, and a depth camera beside it (`Source`)."""

    is_live = True

    def __init__(
        self,
        calibration: Path,  # camera.json of the event camera, with T_events_depth
        events_driver: Any,  # the module neuromorphic_drivers
        depth: RealsenseDepth | None,
        clock: Callable[[], float] = time.time,  # seconds since the epoch
    ) -> None:
        """Open the event camera; raises DataError where there is none, or another than the calibrated one."""
        values = read_json(calibration)
        camera = camera_item(values, str(calibration))
        self._depth, self._clock = depth, clock
        try:
            self._device = events_driver.open(iterator_timeout=TIMEOUT)
        except (RuntimeError, OSError, ValueError) as error:
            raise DataError(f"event camera: {plain(error)}; is it connected?") from error
        properties = self._device.properties()
        size, expected = (properties.width, properties.height), (camera.file.width, camera.file.height)
        if size != expected:
            raise DataError(
                f"{calibration}: expected the camera's {size[0]}x{size[1]} pixels, got "
                f"{expected[0]}x{expected[1]}"
            )
        self.description = f"event camera {plain(self._device.serial())}"
        reprojection = None
        if depth is not None:
            T = camera.file.T_events_depth
            if T is None:
                raise DataError(f"{calibration}: expected T_events_depth, 16 numbers row by row, found none")
            T_events_depth = rigid_motion(T, f"{calibration}: T_events_depth")
            reprojection = DepthReprojection(depth.lens, camera.file.camera, T_events_depth)
            self.description += " and RealSense"
        file = camera.file.model_copy(update={"depth_undistorted": True})
        self.camera = CameraItem(file, "us", "m", reprojection=reprojection)
        self._difference = ClockDifference()
        self._waiting: deque[tuple[float, np.ndarray]] = deque(maxlen=WAITING_DEPTH)
        self._is_closed = threading.Event()
        self._failure: Exception | None = None

    def items(self) -> Iterator[Item]:
        """Yield events as packets come, and depth images between them."""
        yield self.camera
        thread = threading.Thread(target=self._read_depth, name="depth", daemon=True)
        thread.start()
        try:
            with self._device as device:
                for status, packet in device:
                    if self._is_closed.is_set():
                        return
                    if self._failure is not None:
                        raise DataError(f"depth camera: {plain(self._failure)}")
                    if status.ring is not None and packet is not None:
                        yield from self._of_packet(status.ring, packet)
                    yield from self._depth_images()
        except RuntimeError as error:  # unplugged
            raise DataError(f"event camera: {plain(error)}") from error
        finally:
            self._is_closed.set()
            thread.join(1.0)
            if self._depth is not None:
                self._depth.close()

    def close(self) -> None:
        self._is_closed.set()

    def _of_packet(self, ring: Any, packet: Any) -> Iterator[Item]:
        self._difference.add(ring.system_time, ring.current_t / 1e6)
        if packet.polarity_events_overflow_indices is not None:
            yield NoteItem("event camera: events were dropped, the computer did not take them in time")
        events = packet.polarity_events
        if events is not None:
            yield EventsItem(events["x"], events["y"], events["t"], events["on"])
        for frame in getattr(packet, "frames", []):  # of a DAVIS
            is_known = frame.exposure_start_t is not None and frame.exposure_end_t is not None
            taken = (frame.exposure_start_t + frame.exposure_end_t) // 2 if is_known else frame.t
            yield ImageItem(taken, np.minimum(frame.pixels / np.float32(DAVIS_WHITE), np.float32(1)))

    def _depth_images(self) -> Iterator[Item]:
        difference = self._difference.seconds
        while difference is not None and self._waiting:
            stamp, depth = self._waiting.popleft()
            yield DepthItem(round(1e6 * (stamp - difference)), depth)

    def _read_depth(self) -> None:
        if self._depth is None:
            return
        try:
            for stamp, depth in self._depth.images(self._is_closed):
                self._waiting.append((stamp, depth))
        except Exception as error:  # told by the thread of the events
            self._failure = error


def _realsense_lens(intrinsics: Any) -> Lens:
    """Return the depth camera's lens; pixel centres of RealSense are at integers."""
    model = intrinsics.model.name.removeprefix("modified_").removeprefix("inverse_")
    coefficients = tuple(float(c) for c in intrinsics.coeffs)
    pinhole = Camera(
        intrinsics.width, intrinsics.height, intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy
    )
    if not any(coefficients) or model == "none":  # depth of stereo cameras is rectified
        return Lens(pinhole, "plumb_bob", (0.0,) * 5)
    if intrinsics.model.name != "brown_conrady":
        raise DataError(f"RealSense: expected an undistorted depth image, got model {intrinsics.model.name}")
    return Lens(pinhole, model_name(model), coefficients)
