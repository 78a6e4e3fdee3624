"""Reads the small files of a recording: lists of times, images, numbered names."""

import itertools
import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from edslam_ti.camera import LARGEST_SIDE, Camera
from edslam_ti.errors import LONGEST_MESSAGE, DataError, plain
from edslam_ti.tables import LARGEST, read_table, text_lines

LARGEST_NUMBER = 10**16  # in a file name: microseconds since 1970 are 2e15
LARGEST_IMAGE = 1_000_000_000  # bytes of a file
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
STDERR = 2  # file descriptor


def read_numbers(
    path: Path, columns: int, line: str, header_lines: int = 0
) -> np.ndarray:  # [N, columns] float64
    """Return the table in a text file of `columns` numbers a line; `line` describes one in messages."""
    return read_table(path, columns, line, header_lines).rows


def read_timed_paths(path: Path, use: str = "seconds") -> tuple[np.ndarray, list[Path]]:  # [I] s, I files
    """Return the times and files of a list of lines 't path'; paths start at the list's folder.

    `use` states the purpose of the lines in messages.
    """
    times: list[float] = []
    files: list[Path] = []
    for number, text in text_lines(path, f"expected lines 't path', {use}"):
        fields = text.split()
        try:
            time, name = float(fields[0]), fields[1]
        except (ValueError, IndexError) as error:
            raise DataError(f"{path}: line {number}: expected 't path', got '{plain(text, 60)}'") from error
        if not np.isfinite(time) or abs(time) > LARGEST or (times and time <= times[-1]):
            raise DataError(
                f"{path}: line {number}: expected increasing times in seconds, got {plain(fields[0], 40)}"
                f"{f' after {times[-1]:.9f}' if times else ''}"
            )
        times.append(time)
        files.append(path.parent / name)
    if not files:
        raise DataError(f"{path}: expected lines 't path', got an empty file")
    return np.array(times), files


def read_timestamps(path: Path, files: dict[int, Path]) -> np.ndarray:  # [I] s
    """Return the times of numbered files from a list of lines 'number_or_name seconds'."""
    expected = "expected lines 'number_or_name seconds'"
    keys = {key: number for number, f in files.items() for key in (f.name, f.stem, str(number))}
    times: dict[int, float] = {}
    for line, text in text_lines(path, expected):
        *name, seconds = text.split(maxsplit=1)
        try:
            time = float(seconds)
        except ValueError:
            time = np.nan
        if not name or not abs(time) <= LARGEST:
            raise DataError(f"{path}: line {line}: {expected}, got '{plain(text, 60)}'")
        number = keys.get(name[0])
        if number is None and name[0].isdecimal() and int(name[0][:20]) in files:
            number = int(name[0][:20])  # 000012 for 12
        if number in times:
            raise DataError(f"{path}: line {line}: a second time for {plain(name[0], 60)}; keep one")
        if number is not None:  # lines may name images that do not exist
            times[number] = time
    missing = [f.name for number, f in files.items() if number not in times]
    if missing:
        raise DataError(f"{path}: {expected}, got none for {missing[0]} ({len(missing)} such files)")
    return np.array([times[number] for number in files])


def numbered_files(folder: Path, pattern: str, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Return the files of a folder by the last number in their names, in ascending order."""
    found: dict[int, Path] = {}
    files = [p for p in sorted(folder.glob("*")) if p.suffix.lower() in suffixes and p.name[0] != "."]
    matching = [p for p in files if p.match(pattern)]
    if files and not matching:
        raise DataError(f"{folder}: expected files named {pattern}{suffixes[0]}, found {files[0].name}")
    for path in matching:
        numbers = re.findall(r"\d+", path.stem)
        if not numbers:
            raise DataError(f"{path}: expected a number in the file name, as in frame000100{path.suffix}")
        key = int(numbers[-1])
        if key > LARGEST_NUMBER:
            raise DataError(f"{path}: expected a time or an index in the file name, got {plain(key, 30)}")
        if key in found:
            raise DataError(f"{folder}: {found[key].name} and {path.name} both carry number {key}; keep one")
        found[key] = path
    return dict(sorted(found.items()))


def timed_files(folder: Path, suffixes: tuple[str, ...]) -> tuple[np.ndarray, list[Path]]:  # [I] s, I files
    """Return the files of a folder whose names are times, and these, in ascending order.

    A name with a decimal point is in seconds. A whole number is in the unit that makes it a time since the
    epoch (seconds, ms, us or ns), else in microseconds.
    """
    found: list[tuple[float, Path]] = []
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.suffix.lower() not in suffixes or path.name[0] == ".":
            continue
        if not re.fullmatch(r"\d{1,20}(\.\d*)?", path.stem):
            raise DataError(
                f"{path}: expected a time as the file's name, as in 1642689268.899930{path.suffix}"
            )
        found.append((_time_of(path.stem), path))
    found.sort()
    for (before, _), (time, path) in itertools.pairwise(found):
        if time <= before:
            raise DataError(f"{path}: expected a time for each image, got {time:.9f} s twice; keep one")
    return np.array([time for time, _ in found]), [path for _, path in found]


def _time_of(text: str) -> float:  # s
    value = float(text)
    if "." in text:
        return value
    for ticks in (1.0, 1e3, 1e6, 1e9):
        if 5e8 <= value / ticks < 5e9:  # the years 1985 to 2128
            return value / ticks
    return value / 1e6


def read_image(path: Path, camera: Camera) -> np.ndarray:  # [H, W] float32 in [0, 1]
    """Return an image file as grey values of the camera's size."""
    image = decode(path, cv2.IMREAD_GRAYSCALE, camera, "image")
    return image.astype(np.float32) / 255


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of an image file."""
    height, width = decode(path, cv2.IMREAD_UNCHANGED).shape[:2]
    return width, height


def first_image_size(paths: list[Path]) -> tuple[int, int]:
    """Return (width, height) of the first readable image; if none is, raise the first one's error."""
    problem: DataError | OSError | None = None
    for path in paths:
        try:
            return image_size(path)
        except (DataError, OSError) as error:
            problem = problem or error
    raise problem or DataError("expected image files, got none")


def decode(path: Path, flags: int, camera: Camera | None = None, what: str = "image") -> np.ndarray:
    """Return the pixels of an image file as OpenCV decodes them; check the size against `camera` if given.

    Bytes are read here, because OpenCV accepts only names in UTF-8. The size in a PNG's header is checked
    first: a few bytes may claim gigabytes.
    """
    return decode_bytes(file_bytes(path, what), path, flags, camera, what)


def decode_bytes(
    data: bytes, path: Path, flags: int, camera: Camera | None = None, what: str = "image"
) -> np.ndarray:
    """Return the pixels of what an image file holds; `path` names it in messages."""
    if data[:8] == PNG_SIGNATURE and len(data) >= 24:
        width, height = (int.from_bytes(data[k : k + 4], "big") for k in (16, 20))
        check_size(path, (height, width), camera, what)
        if max(width, height) > LARGEST_SIDE:
            raise DataError(
                f"{path}: {what}: expected at most {LARGEST_SIDE} pixels a side, got {width}x{height}"
            )
    try:
        with quiet():
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except (cv2.error, MemoryError) as error:
        raise DataError(f"{path}: not readable as an image ({' '.join(str(error).split())})") from error
    if image is None:
        kind = path.suffix[1:] or "PNG"
        raise DataError(f"{path}: not readable as an image; truncated or not a {kind} file?")
    check_size(path, image.shape, camera, what)
    return np.asarray(image)


def check_size(path: Path, shape: tuple[int, ...], camera: Camera | None, what: str) -> None:
    """Refuse an image of another size than the camera's."""
    if camera is not None and tuple(shape[:2]) != camera.shape:
        raise DataError(
            f"{path}: {what}: expected the camera's {camera.width}x{camera.height} pixels, got "
            f"{shape[1]}x{shape[0]}; state the true camera in camera.json or resize"
        )


def file_bytes(path: Path, what: str) -> bytes:
    """Return the contents of a file of at most `LARGEST_IMAGE` bytes; refuse devices and pipes."""
    if not path.is_file():
        raise FileNotFoundError(plain(f"{path}: {what} not found", LONGEST_MESSAGE))
    try:
        if path.stat().st_size > LARGEST_IMAGE:
            raise DataError(f"{path}: {what}: expected at most {LARGEST_IMAGE} bytes")
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: {what} cannot be read ({error.strerror})") from error


_stderr_lock = threading.Lock()


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress what C libraries print on stderr about a damaged file; the raised error reports it."""
    with _stderr_lock:
        try:
            saved = os.dup(STDERR)
        except OSError:  # closed: nothing can be printed
            saved = None
        if saved is None:
            yield
            return
        try:
            sink = os.open(os.devnull, os.O_WRONLY)
            os.dup2(sink, STDERR)
            os.close(sink)
            yield
        finally:
            os.dup2(saved, STDERR)
            os.close(saved)
