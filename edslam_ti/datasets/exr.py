"""Reads and writes single-channel OpenEXR images (OpenCV's wheels no longer do), of float32 values."""

import io
from pathlib import Path

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.files import check_size, file_bytes, quiet, read_image
from edslam_ti.errors import DataError

CHANNELS = ("Z", "V", "Y", "R")  # R: renderers that repeat a value in R, G and B


def read_exr(path: Path, camera: Camera, what: str = "depth") -> np.ndarray:  # [H, W] float32
    """Return the channel Z, V, Y or R of an OpenEXR file of the camera's size."""
    import OpenEXR

    data = file_bytes(path, f"{what} image")
    try:
        path.name.encode()
        source: str | io.BytesIO = str(path)
    except UnicodeEncodeError:  # OpenEXR takes only names in UTF-8
        source = io.BytesIO(data)
    try:
        with quiet():
            (left, top), (right, bottom) = OpenEXR.File(source, header_only=True).header()["dataWindow"]
            shape = (int(bottom) - int(top) + 1, int(right) - int(left) + 1)
        check_size(path, shape, camera, what)  # before allocating: a few bytes may claim gigabytes
        if isinstance(source, io.BytesIO):
            source.seek(0)
        with quiet(), OpenEXR.File(source, separate_channels=True) as file, np.errstate(all="ignore"):
            channels = {name: np.array(c.pixels, np.float32) for name, c in file.channels().items()}
    except DataError:
        raise
    except (RuntimeError, ValueError, TypeError, KeyError, OverflowError, MemoryError) as error:
        raise DataError(f"{path}: not readable as OpenEXR ({' '.join(str(error).split())})") from error
    for wanted in CHANNELS:
        for name, pixels in channels.items():
            if name.split(".")[-1] == wanted:
                check_size(path, pixels.shape, camera, what)
                return pixels
    if len(channels) == 1:
        return next(iter(channels.values()))
    raise DataError(f"{path}: expected a channel Z, V, Y or R with {what}, got {', '.join(sorted(channels))}")


def write_exr(path: Path, image: np.ndarray, channel: str) -> None:  # [H, W] float32
    """Write float32 values without loss (ZIP compression); the file must be new."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {channel: np.ascontiguousarray(image, np.float32)}) as file:
        file.write(str(path))


def read_grey(path: Path, camera: Camera) -> np.ndarray:  # [H, W] float32 in [0, 1]
    """Return an image as grey values of the camera's size: JPEG, PNG, or OpenEXR with values from 0 to 1."""
    if path.suffix.lower() != ".exr":
        return read_image(path, camera)
    image = read_exr(path, camera, "image")
    if not np.isfinite(image).all():
        raise DataError(f"{path}: image: expected finite brightness from 0 to 1, got values that are not")
    return image
