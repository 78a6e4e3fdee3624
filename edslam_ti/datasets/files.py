"""Reading the small files around an event stream: number tables, images, depth images, numbered names."""

import re
import warnings
from pathlib import Path

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError

FARTHEST_DEPTH = 1e4  # m; renderers write 1e10 or 65504 (half-precision maximum) where they hit nothing


def read_numbers(path: Path, columns: int, line: str) -> np.ndarray:  # [N, columns] float64
    """Return the table in a text file of `columns` numbers a line; `line` describes one in messages."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} not found; expected lines '{line}'")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an empty file is refused below
            rows = np.loadtxt(path, comments="#", ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise DataError(f"{path}: expected {columns} numbers a line '{line}'; {reason}") from error
    if rows.size == 0:
        raise DataError(f"{path}: expected lines '{line}', got an empty file")
    if rows.shape[1] != columns:
        raise DataError(f"{path}: expected {columns} numbers a line '{line}', got {rows.shape[1]}")
    finite = np.isfinite(rows).all(1)
    if not finite.all():
        bad = int(finite.argmin())
        raise DataError(f"{path}: row {bad + 1} of the table holds a value that is not finite: {rows[bad]}")
    return rows


def read_timed_paths(path: Path, use: str = "seconds") -> tuple[np.ndarray, list[Path]]:  # [I] s, I files
    """Return the times and files of a list of lines 't path'; paths start at the list's folder.

    `use` says in a message what the lines are for.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} not found; expected lines 't path', {use}")
    times: list[float] = []
    files: list[Path] = []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            time, name = float(fields[0]), fields[1]
        except (ValueError, IndexError) as error:
            raise DataError(f"{path}: line {number}: expected 't path', got '{line}'") from error
        if not np.isfinite(time) or (times and time <= times[-1]):
            raise DataError(f"{path}: line {number}: expected increasing times in seconds, got {time}")
        times.append(time)
        files.append(path.parent / name)
    if not files:
        raise DataError(f"{path}: expected lines 't path', got an empty file")
    return np.array(times), files


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
        if key in found:
            raise DataError(f"{folder}: {found[key].name} and {path.name} both carry number {key}; keep one")
        found[key] = path
    return dict(sorted(found.items()))


def read_image(path: Path, camera: Camera) -> np.ndarray:  # [H, W] float32 in [0, 1]
    """Return an image file as grey values of the camera's size."""
    image = _decode(path, cv2.IMREAD_GRAYSCALE)
    _check_size(path, image, camera, "image")
    return image.astype(np.float32) / 255


def read_depth(path: Path, camera: Camera, metres_per_unit: float) -> np.ndarray:  # [H, W] float32, m
    """Return a depth image: PNG of 16 bits in `metres_per_unit`, or EXR in metres; 0 = missing.

    EXR values of 10 km and more are what renderers write for "nothing hit" and become 0.
    """
    if path.suffix.lower() == ".exr":
        depth = _decode_exr(path)
        _check_size(path, depth, camera, "depth")
        bad = ~np.isfinite(depth) | (depth < 0)
        if bad.any():
            v, u = np.argwhere(bad)[0]
            raise DataError(
                f"{path}: expected finite depth in metres, 0 where there is none, got {depth[v, u]} at "
                f"column {u}, row {v} ({int(bad.sum())} such pixels)"
            )
        return np.where(depth >= FARTHEST_DEPTH, np.float32(0), depth)
    depth = _decode(path, cv2.IMREAD_UNCHANGED)
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise DataError(
            f"{path}: expected a 16-bit single-channel depth PNG, got {depth.dtype} of shape {depth.shape}"
        )
    _check_size(path, depth, camera, "depth")
    return depth.astype(np.float32) * np.float32(metres_per_unit)


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of an image file."""
    height, width = _decode(path, cv2.IMREAD_UNCHANGED).shape[:2]
    return width, height


def _decode(path: Path, flags: int) -> np.ndarray:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: image not found")
    try:
        image = cv2.imread(str(path), flags)
    except cv2.error as error:
        raise DataError(f"{path}: not readable as an image ({' '.join(str(error).split())})") from error
    if image is None:
        raise DataError(f"{path}: not readable as an image; truncated or not a {path.suffix[1:]} file?")
    return np.asarray(image)


def _decode_exr(path: Path) -> np.ndarray:  # [H, W] float32
    """Return the depth channel of an OpenEXR file (OpenCV's wheels no longer read the format)."""
    import OpenEXR

    if not path.is_file():
        raise FileNotFoundError(f"{path}: depth image not found")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(c.pixels, np.float32) for name, c in file.channels().items()}
    except (RuntimeError, ValueError) as error:
        raise DataError(f"{path}: not readable as OpenEXR ({' '.join(str(error).split())})") from error
    for wanted in ("Z", "V", "Y", "R"):  # R: renderers that repeat depth in R, G and B
        for name, pixels in channels.items():
            if name.split(".")[-1] == wanted:
                return pixels
    if len(channels) == 1:
        return next(iter(channels.values()))
    raise DataError(f"{path}: expected a channel Z, V, Y or R with depth, got {', '.join(sorted(channels))}")


def _check_size(path: Path, image: np.ndarray, camera: Camera, what: str) -> None:
    if image.shape[:2] != camera.shape:
        raise DataError(
            f"{path}: {what}: expected the camera's {camera.width}x{camera.height} pixels, got "
            f"{image.shape[1]}x{image.shape[0]}; state the true camera in camera.json or resize"
        )
