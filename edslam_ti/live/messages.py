"""The binary messages of `edslam live`: a header of 12 bytes, then the payload, all little-endian.

    header    4 bytes "EDSL", u8 version = 1, u8 kind, u16 = 0, u32 bytes of payload
    1 camera  JSON, UTF-8: what camera.json holds (docs/data.md), and time_unit, depth_unit, initial_pose
    2 events  N stamps of 8 bytes, N u16 columns, N u16 rows, N u8 polarities (0 or 1): 13 N bytes
    3 depth   stamp of 8 bytes, u8 encoding, 7 bytes 0, data row by row
    4 image   the same
    5 time    stamp of 8 bytes: all data before it have been sent
    6 end     nothing: the session ends

A stamp is a float64 where time_unit is "s", else an int64. Encodings: 0 float32 (metres, or brightness from 0
to 1), 1 u16 depth in depth_unit or u8 brightness, 2 the bytes of a PNG file (16 bits for depth), 3 nothing:
an image was taken but cannot be used. docs/live.md has an example.
"""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np

from edslam_ti.camera import LARGEST_SIDE
from edslam_ti.datasets.camera_file import validated
from edslam_ti.datasets.files import PNG_SIGNATURE, decode_bytes
from edslam_ti.errors import DataError, plain, shown
from edslam_ti.feeding.intake import DepthUnit, TimeUnit
from edslam_ti.live.items import CameraItem, DepthItem, EndItem, EventsItem, ImageItem, Item, TimeItem

MAGIC, VERSION = b"EDSL", 1
HEADER = struct.Struct("<4sBBHI")
CAMERA, EVENTS, DEPTH, IMAGE, TIME, END = range(1, 7)
FLOATS, INTEGERS, FILE, NOTHING = range(4)  # encodings of images
EVENT_BYTES = 13
IMAGE_HEAD = 16  # bytes before an image's data
MOST_EVENTS = 4_000_000  # of a message
LARGEST: dict[int, int] = {  # bytes of payload
    CAMERA: 1 << 16,
    EVENTS: MOST_EVENTS * EVENT_BYTES,
    DEPTH: 64 << 20,
    IMAGE: 64 << 20,
    TIME: 8,
    END: 0,
}
NAMES = {CAMERA: "camera", EVENTS: "events", DEPTH: "depth", IMAGE: "image", TIME: "time", END: "end"}
REQUIRED = ("width", "height", "fx", "fy", "cx", "cy")
OWN_FIELDS = ("time_unit", "depth_unit", "initial_pose", "has_events")  # of a camera message

Read = Callable[[int], bytes]  # returns so many bytes, fewer only at the end of the stream


# --- writing ---


def encoded(item: Item, camera: CameraItem) -> bytes:
    """Return an item as a message; `camera` says in which unit its stamps are."""
    if isinstance(item, CameraItem):
        return _message(CAMERA, _camera_json(item))
    if isinstance(item, EventsItem):
        columns = (
            np.ascontiguousarray(item.t, _stamp(camera)),
            np.ascontiguousarray(item.x, "<u2"),
            np.ascontiguousarray(item.y, "<u2"),
            np.ascontiguousarray(np.asarray(item.p) > 0, np.uint8),
        )
        return _message(EVENTS, b"".join(column.tobytes() for column in columns))
    if isinstance(item, DepthItem):
        return _message(DEPTH, _stamped(item.t, camera) + _image_bytes(item.depth, np.uint16))
    if isinstance(item, ImageItem):
        return _message(IMAGE, _stamped(item.t, camera) + _image_bytes(item.image, np.uint8))
    if isinstance(item, TimeItem):
        return _message(TIME, _stamped(item.t, camera))
    if isinstance(item, EndItem):
        return _message(END, b"")
    raise DataError(f"a {type(item).__name__} is no message")


def _message(kind: int, payload: bytes) -> bytes:
    if len(payload) > LARGEST[kind]:
        raise DataError(
            f"{NAMES[kind]}: expected at most {LARGEST[kind]} bytes, got {len(payload)}; send smaller pieces"
        )
    return HEADER.pack(MAGIC, VERSION, kind, 0, len(payload)) + payload


def _camera_json(item: CameraItem) -> bytes:
    values: dict[str, Any] = item.file.model_dump(exclude_unset=True)
    values |= {"time_unit": item.time_unit, "depth_unit": item.depth_unit, "has_events": item.has_events}
    if item.initial_pose is not None:
        values["initial_pose"] = [float(v) for v in np.ravel(item.initial_pose)]
    return json.dumps(values).encode()


def _stamp(camera: CameraItem) -> str:
    return "<f8" if camera.time_unit == "s" else "<i8"


def _stamped(t: float, camera: CameraItem) -> bytes:
    return np.array([t], _stamp(camera)).tobytes()


def _image_bytes(image: np.ndarray | None, integers: type) -> bytes:
    if image is None:
        return bytes([NOTHING]) + bytes(7)
    is_integer = image.dtype == integers
    data = np.ascontiguousarray(image, np.dtype(integers if is_integer else np.float32).newbyteorder("<"))
    return bytes([INTEGERS if is_integer else FLOATS]) + bytes(7) + data.tobytes()


# --- reading ---


def read_message(read: Read, camera: CameraItem | None) -> Item | None:
    """Return the next message of a stream; None where the stream ends between two.

    Raises `DataError` for what is no message, and where the stream ends within one. Nothing larger than
    `LARGEST` is ever held.
    """
    head = read(HEADER.size)
    if not head:
        return None
    if len(head) < HEADER.size:
        raise DataError(f"the stream ends within a header, after {len(head)} of {HEADER.size} bytes")
    magic, version, kind, zero, length = HEADER.unpack(head)
    if magic != MAGIC:
        raise DataError(f"expected a message that begins with {MAGIC!r}, got {shown(magic)}")
    if version != VERSION:
        raise DataError(f"expected messages of version {VERSION}, got version {version}")
    if kind not in LARGEST or zero != 0:
        raise DataError(f"expected a message of kind {CAMERA} to {END}, got kind {kind} ({zero})")
    if length > LARGEST[kind]:
        raise DataError(f"{NAMES[kind]}: expected at most {LARGEST[kind]} bytes, got {length}")
    payload = read(length) if length else b""
    if len(payload) < length:
        raise DataError(
            f"{NAMES[kind]}: the stream ends within a message, after {len(payload)} of {length} bytes"
        )
    if kind == CAMERA:
        return _camera_item(payload)
    if kind == END:
        return EndItem()
    if camera is None:
        raise DataError(f"expected a camera message first, got one of kind {NAMES[kind]}")
    if kind == EVENTS:
        return _events_item(payload, camera)
    if len(payload) < (8 if kind == TIME else IMAGE_HEAD):
        raise DataError(f"{NAMES[kind]}: too short, {len(payload)} bytes")
    t = np.frombuffer(payload, _stamp(camera), 1)[0].item()
    if not np.isfinite(t):
        raise DataError(f"{NAMES[kind]}: expected a time stamp, got {t}")
    if kind == TIME:
        return TimeItem(t)
    if kind == DEPTH:
        return DepthItem(t, _read_image(payload, camera, "depth"))
    image = _read_image(payload, camera, "image")
    if image is None:
        raise DataError("image: expected an image, got none")
    return ImageItem(t, image)


def camera_item(values: Any, where: str) -> CameraItem:
    """Return what a camera message, or a camera.json for live data, says; raises DataError naming `where`."""
    if not isinstance(values, dict):
        raise DataError(f"{where}: expected an object, got {type(values).__name__}")
    missing = [name for name in REQUIRED if name not in values]
    if missing:
        raise DataError(f"{where}: expected {', '.join(REQUIRED)}; {', '.join(missing)} missing")
    known = {**{"pixel_centres": "integer"}, **{k: v for k, v in values.items() if k not in OWN_FIELDS}}
    for name, kind, default in (("time_unit", TimeUnit, "us"), ("depth_unit", DepthUnit, "mm")):
        if values.get(name, default) not in get_args(kind):
            raise DataError(
                f"{where}: {name}: expected one of {', '.join(get_args(kind))}, got {shown(values[name])}"
            )
    file = validated(known, where)
    if file.width * file.height > LARGEST[DEPTH] // 4 or max(file.width, file.height) > LARGEST_SIDE:
        raise DataError(f"{where}: {file.width}x{file.height} pixels are too many for a message")
    pose = values.get("initial_pose")
    if pose is not None and not (
        isinstance(pose, list) and len(pose) == 16 and all(isinstance(v, int | float) for v in pose)
    ):
        raise DataError(f"{where}: initial_pose: expected 16 numbers, row by row, got {shown(pose)}")
    return CameraItem(
        file,
        values.get("time_unit", "us"),
        values.get("depth_unit", "mm"),
        None if pose is None else np.array(pose, np.float64).reshape(4, 4),
        bool(values.get("has_events", True)),
    )


def _camera_item(payload: bytes) -> CameraItem:
    try:
        values = json.loads(payload)
    except (ValueError, RecursionError) as error:  # not UTF-8, not JSON, nested too deeply
        raise DataError(f"camera: not readable as JSON: {plain(error)}") from error
    return camera_item(values, "camera")


def _events_item(payload: bytes, camera: CameraItem) -> EventsItem:
    number, rest = divmod(len(payload), EVENT_BYTES)
    if rest:
        raise DataError(f"events: expected {EVENT_BYTES} bytes an event, got {len(payload)} bytes")
    t = np.frombuffer(payload, _stamp(camera), number)
    x = np.frombuffer(payload, "<u2", number, 8 * number)
    y = np.frombuffer(payload, "<u2", number, 10 * number)
    return EventsItem(x, y, t, np.frombuffer(payload, np.uint8, number, 12 * number))


def _read_image(payload: bytes, camera: CameraItem, name: str) -> np.ndarray | None:
    encoding, shape = payload[8], camera.file.camera.shape
    if encoding == NOTHING:
        return None
    if encoding == FILE:
        if payload[IMAGE_HEAD : IMAGE_HEAD + len(PNG_SIGNATURE)] != PNG_SIGNATURE:
            raise DataError(f"{name}: expected the bytes of a PNG file, got something else")
        flags = cv2.IMREAD_UNCHANGED if name == "depth" else cv2.IMREAD_GRAYSCALE
        image = decode_bytes(payload[IMAGE_HEAD:], Path(name), flags, camera.file.camera, "message")
        if name == "depth" and (image.dtype != np.uint16 or image.ndim != 2):
            raise DataError(f"depth: expected a PNG of 16 bits, got {image.dtype} of shape {image.shape}")
        return image
    kinds: dict[int, Any] = {FLOATS: "<f4", INTEGERS: "<u2" if name == "depth" else "u1"}
    if encoding not in kinds:
        raise DataError(f"{name}: expected encoding {FLOATS} to {NOTHING}, got {encoding}")
    dtype = np.dtype(kinds[encoding])
    expected = shape[0] * shape[1] * dtype.itemsize
    if len(payload) - IMAGE_HEAD != expected:
        raise DataError(
            f"{name}: expected {expected} bytes for {shape[1]}x{shape[0]} pixels of {dtype}, got "
            f"{len(payload) - IMAGE_HEAD}"
        )
    return np.frombuffer(payload, dtype, offset=IMAGE_HEAD).reshape(shape)
