"""Messages come out as they went in, and what is no message is refused before it takes memory."""

import json
import struct
from collections.abc import Callable
from io import BytesIO
from typing import Any

import cv2
import numpy as np
import pytest

from edslam_ti.datasets.camera_file import CameraFile
from edslam_ti.errors import DataError
from edslam_ti.live.items import CameraItem, DepthItem, EndItem, EventsItem, ImageItem, Item, TimeItem
from edslam_ti.live.messages import HEADER, LARGEST, MAGIC, encoded, read_message

FILE = CameraFile(width=6, height=4, fx=5.0, fy=5.0, cx=2.5, cy=1.5, pixel_centres="integer")
CAMERA = CameraItem(FILE, "us", "mm", np.eye(4))
EVENTS = EventsItem(np.array([1, 5]), np.array([0, 3]), np.array([10, 1 << 60]), np.array([1, -1]))


def there_and_back(item: Item, camera: CameraItem = CAMERA) -> Any:
    return read_message(BytesIO(encoded(item, camera)).read, camera)


def test_events_come_out_as_they_went_in() -> None:
    events = there_and_back(EVENTS)
    for name in "xyt":
        np.testing.assert_array_equal(getattr(events, name), getattr(EVENTS, name))
    np.testing.assert_array_equal(events.p, [1, 0])
    seconds = CameraItem(FILE, "s")
    stamps = np.array([0.1, 1 / 3])
    event = there_and_back(EventsItem(EVENTS.x, EVENTS.y, stamps, EVENTS.p), seconds)
    np.testing.assert_array_equal(event.t, stamps)


def test_a_camera_comes_out_as_it_went_in() -> None:
    camera = there_and_back(CAMERA)
    assert camera.is_same(CAMERA)
    np.testing.assert_array_equal(camera.initial_pose, np.eye(4))
    lens = FILE.model_copy(update={"distortion": [0.1, 0.0, 0.0, 0.0]})
    assert not CAMERA.is_same(CameraItem(lens, "us", "mm"))
    assert not CAMERA.is_same(CameraItem(FILE, "s", "mm"))


@pytest.mark.parametrize("kind", [np.float32, np.uint16])
def test_depth_comes_out_as_it_went_in(kind: type) -> None:
    depth: np.ndarray = np.arange(24).reshape(4, 6).astype(kind)
    item = there_and_back(DepthItem(12, depth))
    assert item.t == 12
    assert item.depth.dtype == kind
    np.testing.assert_array_equal(item.depth, depth)
    assert there_and_back(DepthItem(12, None)).depth is None


def test_image_time_and_end_come_out_as_they_went_in() -> None:
    image = np.arange(24, dtype=np.uint8).reshape(4, 6)
    np.testing.assert_array_equal(there_and_back(ImageItem(3, image)).image, image)
    assert there_and_back(TimeItem(5)) == TimeItem(5)
    assert isinstance(there_and_back(EndItem()), EndItem)
    assert read_message(BytesIO(b"").read, CAMERA) is None


def test_depth_as_a_png() -> None:
    depth = np.arange(24, dtype=np.uint16).reshape(4, 6)
    payload = struct.pack("<qB7x", 12, 2) + cv2.imencode(".png", depth)[1].tobytes()
    message = HEADER.pack(MAGIC, 1, 3, 0, len(payload)) + payload
    item = read_message(BytesIO(message).read, CAMERA)
    assert isinstance(item, DepthItem)
    np.testing.assert_array_equal(item.depth, depth)


def message(kind: int, payload: bytes, length: int | None = None, magic: bytes = MAGIC) -> bytes:
    return HEADER.pack(magic, 1, kind, 0, len(payload) if length is None else length) + payload


def camera_of(**values: Any) -> bytes:
    known = {"width": 6, "height": 4, "fx": 5.0, "fy": 5.0, "cx": 2.5, "cy": 1.5}
    return message(1, json.dumps(known | values).encode())


BIG_PNG = cv2.imencode(".png", np.zeros((1, 1), np.uint16))[1].tobytes()
BIG_PNG = BIG_PNG[:16] + struct.pack(">II", 30000, 30000) + BIG_PNG[24:]


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"GET / HTTP/1.1\r\n", "expected a message that begins with b'EDSL', got b'GET '"),
        (message(2, b"", 1 << 31), "events: expected at most 52000000 bytes, got 2147483648"),
        (message(9, b""), "kind 1 to 6, got kind 9"),
        (message(2, bytes(27)), "13 bytes an event, got 27"),
        (message(2, bytes(13), 26), "ends within a message, after 13 of 26 bytes"),
        (b"EDSL\x01", "ends within a header"),
        (message(3, bytes(16)), "expected 96 bytes for 6x4 pixels of float32, got 0"),
        (message(3, bytes(8) + b"\x09" + bytes(7)), "encoding 0 to 3, got 9"),
        (message(3, bytes(8) + b"\x02" + bytes(7) + BIG_PNG), "camera's 6x4 pixels, got 30000x30000"),
        (message(3, bytes(8) + b"\x02" + bytes(7) + b"junk"), "the bytes of a PNG file"),
        (message(5, b""), "too short, 0 bytes"),
        (HEADER.pack(MAGIC, 7, 2, 0, 0), "of version 1, got version 7"),
        (message(1, b"[" * 60000), "camera: not readable as JSON"),
        (message(1, b"{}"), "width, height, fx, fy, cx, cy missing"),
        (camera_of(width=-1), "camera: width"),
        (camera_of(time_unit="days"), "time_unit: expected one of s, ms, us, ns, got 'days'"),
        (camera_of(initial_pose=[1, 2]), "16 numbers"),
        (camera_of(width=30000, height=30000, fx=3e4, fy=3e4, cx=1.0, cy=1.0), "too many for a message"),
    ],
)
def test_what_is_no_message_is_refused_in_one_line(data: bytes, expected: str) -> None:
    with pytest.raises(DataError) as error:
        read_message(BytesIO(data).read, CAMERA)
    assert expected in str(error.value)
    assert len(str(error.value)) < 300


def test_data_before_the_camera_are_refused() -> None:
    with pytest.raises(DataError, match="a camera message first, got one of kind events"):
        read_message(BytesIO(encoded(EVENTS, CAMERA)).read, None)


def test_random_bytes_never_raise_anything_else() -> None:
    random = np.random.default_rng(0)
    good = b"".join(
        encoded(item, CAMERA)
        for item in (CAMERA, EVENTS, DepthItem(1, np.zeros((4, 6), np.uint16)), TimeItem(3))
    )

    def read_all(read: Callable[[int], bytes]) -> int:
        camera, number = None, 0
        while (item := read_message(read, camera)) is not None:
            camera = item if isinstance(item, CameraItem) else camera
            number += 1
        return number

    assert read_all(BytesIO(good).read) == 4
    for _ in range(300):
        data = bytearray(good)
        for k in random.integers(0, len(data), random.integers(1, 4)):
            data[k] = random.integers(256)
        try:
            read_all(BytesIO(bytes(data[: random.integers(len(data))])).read)
        except DataError:
            continue


def test_an_item_that_is_too_large_is_not_sent() -> None:
    number = LARGEST[2] // 13 + 1
    with pytest.raises(DataError, match="send smaller pieces"):
        encoded(EventsItem(*(np.zeros(number, np.uint8) for _ in range(4))), CAMERA)
