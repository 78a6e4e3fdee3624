"""Reads depth images as sensors and renderers write them, and decides which values mean missing depth.

PNG: 16 bits, one channel, in a stated unit. OpenEXR: metres, float or half, in a channel Z, V, Y or R.

These values count as missing: 0, negative values, NaN and infinity, the largest value of the type (65535 in
PNG: "no measurement" or "beyond the range", 65504 in half floats), 10 km and more (renderers write 1e10 where
nothing is hit), and the value that camera.json states as `invalid`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import EventDepthSequence, has_variation
from edslam_ti.datasets.exr import read_exr
from edslam_ti.datasets.files import decode
from edslam_ti.errors import DataError

FARTHEST_DEPTH = 1e4  # m
LOOKED_AT = 8  # depth images, and as many grey images, that are read when a sequence is opened
NEARLY_ALL = 0.8  # of these images


@dataclass(frozen=True)
class DepthFormat:
    """Meaning of the numbers in depth images."""

    metres_per_unit: float  # PNG
    invalid: float | None = None  # in the file's own units; another value that means no measurement


def read_depth(path: Path, camera: Camera, format: DepthFormat) -> np.ndarray:  # [H, W] float32, m
    """Return a depth image in metres, 0 = missing.

    Raises `FileNotFoundError`, and `DataError` if the file is no depth image of the camera's size.
    """
    if path.suffix.lower() == ".exr":
        depth = read_exr(path, camera)
        with np.errstate(invalid="ignore"):
            is_measured = (depth > 0) & (depth < FARTHEST_DEPTH)  # False for NaN
        if format.invalid is not None:
            is_measured &= depth != np.float32(format.invalid)
        return np.where(is_measured, depth, np.float32(0))
    raw = decode(path, cv2.IMREAD_UNCHANGED, camera, "depth")
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise DataError(
            f"{path}: expected a 16-bit single-channel depth PNG, got {raw.dtype} of shape {raw.shape}"
        )
    depth = raw.astype(np.float32) * np.float32(format.metres_per_unit)
    is_missing = (raw == np.iinfo(raw.dtype).max) | (depth >= FARTHEST_DEPTH)
    if format.invalid is not None:
        is_missing |= raw == format.invalid
    depth[is_missing] = 0
    return depth


def look_at_images(sequence: EventDepthSequence, folder: Path) -> None:
    """Read a few depth and grey images of a sequence that is being opened; set its `depth_varies`.

    Values of no usual camera are noted.

    Raises `DataError` if most of them cannot be read, or if (nearly) all depth images show the same single
    value or none: the sensor was covered or saturated, or the images are no depth. Images that show one value
    each, but different ones, are accepted: they may show a flat wall seen at right angles.
    """
    for line in sequence.camera.oddities:
        sequence.note(line)
    _read_some(len(sequence.image_timestamps), sequence.image, "grey images")
    depths = _read_some(len(sequence.depth_timestamps), sequence.depth, "depth images")
    flat = [float(depth.max()) for depth in depths if not has_variation(depth)]  # m, 0: nothing measured
    varied = len(depths) - len(flat)
    if depths and len(flat) >= NEARLY_ALL * len(depths):
        same = {value for value in flat if value > 0}
        if len(same) < 2:
            what = f"is missing or {same.pop():.6g} m" if same else "is missing (0 or the largest value)"
            raise DataError(
                f"{folder}: depth has no variation: every pixel {what} in {len(flat)} of the {len(depths)} "
                "depth images looked at; was the sensor covered, or is this not depth?"
            )
    sequence.depth_varies = varied > len(flat)


def _read_some(number: int, read: Callable[[int], np.ndarray], what: str) -> list[np.ndarray]:
    """Return a few evenly spaced images of a sequence, without unreadable ones; raise if most are."""
    indices = np.unique(np.linspace(0, number - 1, LOOKED_AT).astype(int)) if number else np.empty(0, int)
    images: list[np.ndarray] = []
    errors: list[DataError | OSError] = []
    for index in indices:
        try:
            images.append(read(int(index)))
        except (DataError, OSError) as error:
            errors.append(error)
    if len(errors) > len(images):
        raise DataError(f"{errors[0]} ({len(errors)} of {len(indices)} {what} looked at cannot be used)")
    return images
