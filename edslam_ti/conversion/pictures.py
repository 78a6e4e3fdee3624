"""Writes depth and grey images without loss: PNG where it holds every value to the bit, else OpenEXR."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from edslam_ti.datasets.exr import write_exr
from edslam_ti.errors import DataError

USUAL_SCALES = (1000.0, 5000.0, 10000.0, 4000.0, 256.0, 6553.5)  # units per metre of depth PNG
LARGEST_UNIT = np.iinfo(np.uint16).max - 1  # the largest value of the type means no measurement
MOST_VALUES = 20_000  # different depths of an image that a unit is sought in


def depth_units(depth: np.ndarray, scale: float) -> np.ndarray | None:  # [H, W] m -> [H, W] uint16
    """Return a depth image in 1 / `scale` metres; None: it cannot be read back to the bit."""
    unit = np.float32(1 / scale)
    units = np.rint(depth / np.float64(unit))
    if units.max(initial=0) > LARGEST_UNIT:
        return None
    whole = units.astype(np.uint16)
    return whole if (whole.astype(np.float32) * unit == depth).all() else None


def exact_scale(depths: Iterable[np.ndarray]) -> float | None:  # [H, W] float32 m each
    """Return the units per metre in which 16-bit images hold these depths to the bit; None: there are none.

    The usual units are tried first, then the one that the differences of the depths suggest.
    """
    images = list(depths)
    for scale in [*USUAL_SCALES, *(s for image in images[:1] for s in _suggested(image))]:
        if all(depth_units(depth, scale) is not None for depth in images):
            return scale
    return None


def _suggested(depth: np.ndarray) -> list[float]:  # [H, W] float32 m
    values = np.unique(depth[depth > 0]).astype(np.float64)[:MOST_VALUES]
    if len(values) < 3:
        return []
    unit = float(np.diff(values).min())
    for value in values[values > 2 * unit]:  # each larger value makes the unit more exact
        unit = value / max(round(value / unit), 1)
    scale = 1 / unit
    return [s for s in (float(f"{scale:.{digits}g}") for digits in (3, 5, 7)) if 1 <= s <= 1e6]


def write_depth(folder: Path, stem: str, depth: np.ndarray, scale: float | None) -> str:  # [H, W] float32 m
    """Write a depth image in 1 / `scale` metres, else as float32 metres; return the file's name."""
    units = None if scale is None else depth_units(depth, scale)
    if units is None:
        write_exr(folder / f"{stem}.exr", depth, "Z")
        return f"{stem}.exr"
    return _write_png(folder / f"{stem}.png", units)


def write_grey(folder: Path, stem: str, image: np.ndarray) -> str:  # [H, W] float32 in [0, 1]
    """Write a grey image as 8 bits where they hold it to the bit, else as float32; return its file's name."""
    levels = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    if (levels.astype(np.float32) / 255 == image).all():
        return _write_png(folder / f"{stem}.png", levels)
    write_exr(folder / f"{stem}.exr", image, "Y")
    return f"{stem}.exr"


def _write_png(path: Path, image: np.ndarray) -> str:
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not done:
        raise DataError(f"{path}: the image cannot be written as PNG")
    path.write_bytes(data.tobytes())
    return path.name
