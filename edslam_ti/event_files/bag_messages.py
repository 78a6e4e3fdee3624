"""Messages of ROS bags from their bytes: events, images, IMU.

The bytes are read directly. ROS 1 packs fields without gaps; ROS 2 (CDR) aligns each to its size. Fields
have the same order in both, but for the number `seq` at the beginning of ROS 1's header.
"""

from dataclasses import dataclass

import numpy as np

from edslam_ti.errors import DataError, plain
from edslam_ti.event_files import decoders
from edslam_ti.event_files.stream import RawEvents

PACKED_EVENT = np.dtype(
    [("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nsec", "<u4"), ("p", "u1")]
)  # ROS 1: 13 bytes
# ROS 2: fields are aligned to their size within the message, so that events follow each other in 16 bytes.
# The array begins at a multiple of 4; all events but the first have two bytes between y and the time.
ALIGNED_EVENT = np.dtype(
    {
        "names": ["x", "y", "sec", "nsec", "p"],
        "formats": ["<u2", "<u2", "<i4", "<u4", "u1"],
        "offsets": [0, 2, 6, 10, 14],
        "itemsize": 16,
    }
)
FIRST_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("sec", "<i4"), ("nsec", "<u4"), ("p", "u1")])
CHANNELS = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "8UC3": 3, "8UC4": 4}
DEEP = {"mono16": "u2", "16UC1": "u2", "32FC1": "f4"}


class Message:
    """Reads the fields of one message one after the other."""

    def __init__(self, data: bytes, is_ros1: bool) -> None:
        self._data = memoryview(data)
        self._is_ros1 = is_ros1
        self._start = 0 if is_ros1 else 4  # CDR begins with four bytes about itself
        if not is_ros1 and (len(data) < 4 or data[1] != 1):
            raise DataError("expected a little-endian CDR message")
        self._at = self._start

    def number(self, code: str) -> int:
        """Return one whole number of a type of `struct`."""
        return int(self.numbers(code, 1)[0])

    def numbers(self, code: str, count: int) -> np.ndarray:  # [count]
        dtype = np.dtype(code).newbyteorder("<")
        self._align(dtype.itemsize)
        if count * dtype.itemsize > len(self._data) - self._at:
            raise DataError(f"ends after {len(self._data)} bytes, before its last field")
        result = np.frombuffer(self._data, dtype, count, self._at)
        self._at += count * dtype.itemsize
        return result

    def text(self) -> str:
        return self.bytes(self.number("u4")).rstrip(b"\x00").decode("utf-8", "replace")

    def bytes(self, count: int) -> bytes:
        if count > len(self._data) - self._at:
            raise DataError(f"ends after {len(self._data)} bytes, before its last field")
        self._at += count
        return bytes(self._data[self._at - count : self._at])

    def header(self) -> int:
        """Return the header's time in nanoseconds."""
        if self._is_ros1:
            self.number("u4")
        seconds, nanoseconds = self.number("u4" if self._is_ros1 else "i4"), self.number("u4")
        self.text()
        return seconds * 1_000_000_000 + nanoseconds

    def events(self) -> RawEvents:
        """Return an array of events; t in nanoseconds."""
        count = self.number("u4")
        if self._is_ros1:
            rows = np.frombuffer(self.bytes(13 * count), PACKED_EVENT)
            return _raw([rows])
        if count == 0:
            return _raw([np.empty(0, FIRST_EVENT)])
        first = np.frombuffer(self.bytes(13), FIRST_EVENT)
        self.bytes(1 if count > 1 else 0)
        # The last event ends with its polarity, one byte before the next multiple of 16.
        rest = np.frombuffer(self.bytes(max(0, 16 * (count - 1) - 1)) + b"\x00" * (count > 1), ALIGNED_EVENT)
        return _raw([first, rest])

    def _align(self, size: int) -> None:
        if not self._is_ros1:
            self._at += -(self._at - self._start) % size


def _raw(parts: list[np.ndarray]) -> RawEvents:
    def column(name: str) -> np.ndarray:
        return np.concatenate([part[name] for part in parts])

    t = column("sec").astype(np.int64) * 1_000_000_000 + column("nsec")
    return RawEvents(column("x"), column("y"), t, column("p"))


@dataclass(frozen=True)
class EventMessage:
    """One message with events."""

    stamp: int  # ns, of its header
    size: tuple[int, int]  # width, height
    events: RawEvents  # t in nanoseconds


class EventReader:
    """Reads the event messages of one topic in their order, for EVT 3.0 goes on from one to the next."""

    def __init__(self, type_name: str, is_ros1: bool) -> None:
        self._is_packet = is_packet(type_name)
        self._is_ros1 = is_ros1
        self._evt3 = decoders.VectorDecoder(decoders.EVT3)
        self.encoding = ""  # of the last packet

    def __call__(self, data: bytes) -> EventMessage:
        message = Message(data, self._is_ros1)
        stamp = message.header()
        height, width = message.number("u4"), message.number("u4")
        if not self._is_packet:
            return EventMessage(stamp, (width, height), message.events())
        message.number("u8")  # running number
        time_base = message.number("u8")
        self.encoding = message.text()
        is_big = message.number("u1")
        words = message.bytes(message.number("u4"))
        if is_big and self.encoding != "mono":
            raise DataError(f"expected little-endian events, got big-endian ones of '{self.encoding}'")
        return EventMessage(stamp, (width, height), self._decoded(words, time_base))

    def _decoded(self, words: bytes, time_base: int) -> RawEvents:
        if self.encoding == "mono":
            return decoders.mono(words, time_base)
        if self.encoding == "evt3":
            raw = self._evt3(np.frombuffer(words, "<u2", len(words) // 2))
        elif self.encoding == "libcaer":
            raw = decoders.libcaer(words, time_base)
        elif self.encoding == "libcaer_cmp":
            raw = decoders.libcaer_cmp(words, time_base)
        else:
            known = "evt3, libcaer, libcaer_cmp, mono"
            raise DataError(f"expected events encoded as {known}, got '{plain(self.encoding, 40)}'")
        return RawEvents(raw.x, raw.y, raw.t * 1000, raw.p)


def is_packet(type_name: str) -> bool:
    """Return whether a type of message holds encoded events rather than an array of them."""
    return type_name.endswith("/EventPacket") or type_name.startswith("event_array_msgs/")


def image_of(data: bytes, is_ros1: bool, is_compressed: bool) -> tuple[int, np.ndarray]:
    """Return stamp in ns and a grey image [H, W] uint8, or depth [H, W] uint16 or float32 as it is stored."""
    import cv2

    message = Message(data, is_ros1)
    stamp = message.header()
    if is_compressed:
        text = message.text()
        pixels = message.bytes(message.number("u4"))
        if "compressedDepth" in text:  # 12 bytes about the encoding of floats precede a PNG
            pixels = pixels[12:]
        image = cv2.imdecode(np.frombuffer(pixels, np.uint8), cv2.IMREAD_ANYDEPTH)
        if image is None:
            raise DataError(f"expected a compressed image, got '{plain(text, 40)}' that cannot be decoded")
        return stamp, np.asarray(image)
    height, width = message.number("u4"), message.number("u4")
    encoding, is_big, step = message.text(), message.number("u1"), message.number("u4")
    pixels = message.bytes(message.number("u4"))
    if encoding in DEEP:
        dtype = np.dtype(DEEP[encoding]).newbyteorder(">" if is_big else "<")
        rows = _rows(pixels, height, step, width * dtype.itemsize)
        return stamp, rows.view(dtype).astype(dtype.newbyteorder("="))
    if encoding.startswith("bayer_") and encoding.endswith("8"):
        # OpenCV names the pattern by the second row and column.
        name = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}.get(encoding[6:10], "")
        if name:
            mosaic = _rows(pixels, height, step, width)
            return stamp, cv2.cvtColor(mosaic, getattr(cv2, f"COLOR_Bayer{name}2GRAY"))
    if encoding not in CHANNELS:
        raise DataError(f"expected an image of 8 or 16 bits, got encoding '{plain(encoding, 40)}'")
    channels = CHANNELS[encoding]
    image = _rows(pixels, height, step, width * channels)
    if channels == 1:
        return stamp, image
    order = "RGB" if encoding.startswith("rgb") else "BGR"
    code = getattr(cv2, f"COLOR_{order}{'A' if channels == 4 else ''}2GRAY")
    return stamp, cv2.cvtColor(image.reshape(height, width, channels), code)


def _rows(pixels: bytes, height: int, step: int, length: int) -> np.ndarray:  # [height, length] uint8
    if step < length or len(pixels) < height * step:
        raise DataError(
            f"expected {height} rows of {length} bytes, got {len(pixels)} bytes in rows of {step}"
        )
    rows = np.frombuffer(pixels, np.uint8, height * step).reshape(height, step)
    return np.ascontiguousarray(rows[:, :length])


def imu_of(data: bytes, is_ros1: bool) -> tuple[int, np.ndarray]:  # [6]
    """Return stamp in ns, angular velocity (rad/s) and acceleration (m/s^2) of a sensor_msgs/Imu."""
    message = Message(data, is_ros1)
    stamp = message.header()
    values = message.numbers("f8", 37)
    # orientation 4, its covariance 9, angular velocity 3, covariance 9, acceleration 3, covariance 9
    return stamp, np.concatenate([values[13:16], values[25:28]])
