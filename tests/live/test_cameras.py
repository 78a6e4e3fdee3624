"""Cameras' drivers, with stand-ins that have the documented interfaces; no hardware."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from edslam_ti.errors import DataError, MissingExtraError
from edslam_ti.live.cameras import CameraSource, ClockDifference, RealsenseDepth, load_driver
from edslam_ti.live.items import CameraItem, DepthItem, EventsItem, ImageItem, NoteItem

EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
HOST = 1_700_000_000.0  # seconds, of the computer's clock when the camera's is 0


def packet(first: int, number: int, **more: Any) -> SimpleNamespace:
    events = np.zeros(number, EVENT)
    events["t"] = first + 10 * np.arange(number)
    events["x"], events["y"], events["on"] = 3, 2, True
    return SimpleNamespace(polarity_events=events, polarity_events_overflow_indices=None, **more)


class Device:
    """Stands in for what neuromorphic_drivers.open returns."""

    def __init__(self, packets: list[Any]) -> None:
        self.packets, self.is_open = packets, False

    def properties(self) -> Any:
        return SimpleNamespace(width=8, height=6)

    def serial(self) -> str:
        return "0001"

    def __enter__(self) -> "Device":
        self.is_open = True
        return self

    def __exit__(self, *arguments: object) -> None:
        self.is_open = False

    def __iter__(self) -> Iterator[Any]:
        for part in self.packets:
            if isinstance(part, Exception):
                raise part
            if part is None:  # nothing came within the timeout
                yield SimpleNamespace(system_time=HOST, ring=None), None
                continue
            newest = int(part.polarity_events["t"][-1])
            ring = SimpleNamespace(system_time=HOST + newest / 1e6 + 0.003, current_t=newest)
            yield SimpleNamespace(system_time=ring.system_time, ring=ring), part


def driver(packets: list[Any]) -> Any:
    device = Device(packets)
    return SimpleNamespace(open=lambda iterator_timeout: device, device=device)


class Pipeline:
    """Stands in for pyrealsense2.pipeline."""

    def __init__(self, images: list[tuple[float, np.ndarray]], domain: str = "global_time") -> None:
        self.images, self.domain, self.is_stopped = list(images), domain, False
        self.is_done = threading.Event()

    def start(self) -> Any:
        model = SimpleNamespace(name="brown_conrady")
        intrinsics = SimpleNamespace(
            width=8, height=6, fx=8.0, fy=8.0, ppx=3.5, ppy=2.5, model=model, coeffs=[0.0] * 5
        )
        stream = SimpleNamespace(
            as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: intrinsics)
        )
        return SimpleNamespace(get_stream=lambda which: stream)

    def try_wait_for_frames(self, milliseconds: int) -> tuple[bool, Any]:
        if not self.images:
            self.is_done.set()
            return False, None
        stamp, depth = self.images.pop(0)
        frame = SimpleNamespace(
            get_data=lambda: depth,
            get_units=lambda: 0.001,
            get_timestamp=lambda: 1000 * stamp,
            get_frame_timestamp_domain=lambda: self.domain,
        )
        return True, SimpleNamespace(get_depth_frame=lambda: frame)

    def stop(self) -> None:
        self.is_stopped = True


def realsense(pipeline: Pipeline) -> RealsenseDepth:
    names = SimpleNamespace(depth="depth")
    domains = SimpleNamespace(hardware_clock="hardware_clock", global_time="global_time")
    return RealsenseDepth(SimpleNamespace(pipeline=lambda: pipeline, stream=names, timestamp_domain=domains))


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    values = {"width": 8, "height": 6, "fx": 8.0, "fy": 8.0, "cx": 3.5, "cy": 2.5}
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(values | {"T_events_depth": np.eye(4).ravel().tolist()}))
    return path


def test_events_and_depth_come_on_one_clock(calibration: Path) -> None:
    depth = np.full((6, 8), 1500, np.uint16)
    pipeline = Pipeline([(HOST + 0.5, depth)])
    packets = [packet(1000, 50), None, packet(2000, 50)]
    source = CameraSource(calibration, driver(packets), realsense(pipeline))
    items = source.items()
    camera = next(items)
    assert isinstance(camera, CameraItem)
    assert camera.reprojection is not None
    assert (camera.time_unit, camera.depth_unit) == ("us", "m")
    first = next(items)
    assert isinstance(first, EventsItem)
    assert (first.t[0], first.x[0], first.y[0], bool(first.p[0])) == (1000, 3, 2, True)
    pipeline.is_done.wait(5.0)
    rest = list(items)
    [image] = [item for item in rest if isinstance(item, DepthItem)]
    assert image.depth is not None
    assert image.depth.dtype == np.float32
    assert image.depth[0, 0] == pytest.approx(1.5)
    assert image.t == pytest.approx(500_000 - 3000, abs=1)  # packets take 3 ms to arrive
    np.testing.assert_allclose(camera.reprojection(image.depth)[2:4, 2:6], 1.5)
    assert sum(len(item.t) for item in rest if isinstance(item, EventsItem)) == 50
    assert pipeline.is_stopped


def test_images_and_overflows_of_a_davis(calibration: Path) -> None:
    pixels = np.full((6, 8), 32736, np.uint16)
    frame = SimpleNamespace(start_t=900, exposure_start_t=1000, exposure_end_t=1200, t=1300, pixels=pixels)
    part = packet(1000, 5, frames=[frame])
    part.polarity_events_overflow_indices = np.array([2])
    items = list(CameraSource(calibration, driver([part]), None).items())
    [image] = [item for item in items if isinstance(item, ImageItem)]
    assert image.t == 1100
    np.testing.assert_allclose(image.image, 0.5)
    assert any(isinstance(item, NoteItem) and "dropped" in item.text for item in items)


def test_what_is_wrong_with_cameras_is_told_in_one_line(calibration: Path) -> None:
    def none(iterator_timeout: float) -> Any:
        raise RuntimeError("no device found")

    with pytest.raises(DataError, match="event camera: no device found; is it connected"):
        CameraSource(calibration, SimpleNamespace(open=none), None)
    unplugged = driver([packet(0, 5), RuntimeError("LIBUSB_ERROR_NO_DEVICE")])
    with pytest.raises(DataError, match="event camera: LIBUSB_ERROR_NO_DEVICE"):
        list(CameraSource(calibration, unplugged, None).items())
    values = json.loads(calibration.read_text())
    calibration.write_text(json.dumps(values | {"width": 9}))
    with pytest.raises(DataError, match="camera's 8x6 pixels, got 9x6"):
        CameraSource(calibration, driver([]), None)
    del values["T_events_depth"]
    calibration.write_text(json.dumps(values))
    with pytest.raises(DataError, match="T_events_depth"):
        CameraSource(calibration, driver([]), realsense(Pipeline([])))


def test_depth_on_the_cameras_own_clock_is_refused(calibration: Path) -> None:
    pipeline = Pipeline([(0.5, np.ones((6, 8), np.uint16))], domain="hardware_clock")
    packets = [packet(k, 5) for k in range(0, 1_000_000, 100)]
    source = CameraSource(calibration, driver(packets), realsense(pipeline))
    with pytest.raises(DataError, match="global time"):
        list(source.items())


def test_a_driver_that_is_missing_names_the_extra() -> None:
    with pytest.raises(MissingExtraError, match=r"edslam-ti\[cameras\]"):
        load_driver("no_such_driver")


def test_the_smallest_delay_counts() -> None:
    difference = ClockDifference()
    assert difference.seconds is None
    for arrival, stamp in ((10.005, 1.0), (10.502, 1.5), (11.009, 2.0)):
        difference.add(arrival, stamp)
    assert difference.seconds == pytest.approx(9.002)
    for k in range(12, 40):  # the clocks drift apart, old differences are forgotten
        difference.add(k + 0.01, k - 9.0)
    assert difference.seconds == pytest.approx(9.01)
