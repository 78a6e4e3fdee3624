"""AEDAT4 files of iniVation's cameras: events, and perhaps grey frames and IMU."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.errors import DataError, MissingExtraError, plain
from edslam_ti.event_files.choice import chosen
from edslam_ti.event_files.decoded import DecodedRows, Parts
from edslam_ti.event_files.hdf5 import INSTALL
from edslam_ti.event_files.stream import Clock, RawEvents

MAGIC = b"#!AER-DAT4.0"
BYTES_PER_EVENT = 3  # least that compressed events take
GRAVITY = 9.80665  # m/s^2; the files state acceleration in g, angular velocity in degrees per second


def is_aedat4(path: Path) -> bool:
    """Return whether a file is AEDAT4 by its first bytes."""
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def aedat4_streams(path: Path) -> dict[str, str]:
    """Return what a file holds by the number of the stream: "events", "frame", "imus" or "triggers"."""
    streams = _opened(path).id_to_stream()
    return {str(number): streams[number]["type"] for number in sorted(streams)}


def aedat4_rows(path: Path, group: str | None) -> tuple[DecodedRows, tuple[int, int] | None]:
    """Return the events of a stream, and the size of its image."""
    stream, notes = _stream(path, "events", group)
    about = _opened(path).id_to_stream()[stream]
    size = (int(about["width"]), int(about["height"])) if "width" in about and "height" in about else None
    rows = DecodedRows(
        path,
        lambda rows: _parts(rows, stream),
        clock=Clock(1e6),
        most_events=path.stat().st_size // BYTES_PER_EVENT,
        part=f"stream {stream}",
    )
    rows.opening_notes = notes
    return rows, size


def aedat4_images(path: Path, stream: str | None = None) -> Iterator[tuple[float, np.ndarray]]:
    """Yield times (s, the middle of the exposure where it is known) and grey images [H, W] uint8."""
    import cv2

    number, _ = _stream(path, "frame", stream)
    for packet in _packets(path, number):
        frame = packet["frame"]
        begin, end = frame["exposure_begin_t"], frame["exposure_end_t"]
        stamp = (begin + end) / 2 if 0 < begin <= end else frame["t"]
        image = frame["pixels"]
        if image.ndim == 3:
            image = cv2.cvtColor(image[..., :3], cv2.COLOR_RGB2GRAY if _is_rgb(frame) else cv2.COLOR_BGR2GRAY)
        yield float(stamp) / 1e6, np.asarray(image)


def aedat4_imu(path: Path, stream: str | None = None) -> Iterator[tuple[float, np.ndarray]]:
    """Yield times (s) and measurements [6]: angular velocity (rad/s), acceleration (m/s^2)."""
    number, _ = _stream(path, "imus", stream)
    for packet in _packets(path, number):
        for row in packet["imus"]:
            turning = [math.radians(row[f"gyroscope_{axis}"]) for axis in "xyz"]
            pushing = [GRAVITY * float(row[f"accelerometer_{axis}"]) for axis in "xyz"]
            yield float(row["t"]) / 1e6, np.array([*turning, *pushing])


def _is_rgb(frame: dict[str, Any]) -> bool:
    return str(frame.get("format", "")).startswith("RGB")


def _parts(rows: DecodedRows, stream: int) -> Parts:
    # The library does not say where in the file it is: estimate by the number of events.
    number, most = 0, max(1, rows.path.stat().st_size // 8)
    for packet in _packets(rows.path, stream):
        events = packet["events"]
        number += len(events)
        raw = RawEvents(events["x"], events["y"], events["t"].astype(np.int64), events["on"].view(np.uint8))
        yield raw, min(1.0, number / most)


def _opened(path: Path) -> Any:
    try:
        import aedat
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"{path}: AEDAT4 files need {INSTALL}") from error
    try:
        return aedat.Decoder(str(path))
    except (RuntimeError, OSError, ValueError) as error:
        raise _damaged(path, error) from error


def _packets(path: Path, stream: int) -> Iterator[dict[str, Any]]:
    decoder = iter(_opened(path))
    while True:
        try:
            packet = next(decoder, None)
        except (RuntimeError, OSError, ValueError) as error:
            raise _damaged(path, error) from error
        if packet is None:
            return
        if packet["stream_id"] == stream:
            yield packet


def _damaged(path: Path, error: Exception) -> DataError:
    return DataError(f"{path}: not readable as AEDAT4 ({plain(error)}); copy or download it again")


def _stream(path: Path, kind: str, wanted: str | None) -> tuple[int, list[str]]:
    """Return the number of a stream, and notes."""
    streams = aedat4_streams(path)
    there = [number for number, name in streams.items() if name == kind]
    if not there:
        found = ", ".join(f"{number} ({name})" for number, name in streams.items())
        raise DataError(f"{path}: expected a stream of {kind}, got {plain(found) or 'none'}")
    if wanted is None and len(there) > 1:
        others = ", ".join(there[1:])
        return int(there[0]), [
            f"holds streams of {kind} {', '.join(there)}; {there[0]} is read, not {others}"
        ]
    number, notes = chosen(str(path), f"streams of {kind}", there, wanted)
    return int(number), notes
