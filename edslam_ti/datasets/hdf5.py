"""Depth, images and poses in HDF5 files; events are read by edslam_ti/event_files."""

import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.calibration import lens_of, numbers
from edslam_ti.datasets.depth import FARTHEST_DEPTH
from edslam_ti.errors import DataError, MissingExtraError, plain
from edslam_ti.lenses import Lens

CHUNKS = 64_000_000  # bytes of decompressed images that are kept


class Hdf5File:
    """A file whose data sets are read by their path; errors are one line."""

    def __init__(self, path: Path) -> None:
        try:
            import h5py
        except ModuleNotFoundError as error:
            raise MissingExtraError("HDF5 files need pip install 'edslam-ti[formats]'") from error
        with contextlib.suppress(ModuleNotFoundError):  # gzip and lzf can be read without it
            import hdf5plugin  # noqa: F401 (it registers compressions)
        self.path = path
        if not path.is_file():
            raise FileNotFoundError(f"{path} not found")
        try:
            self._file = h5py.File(path, "r", rdcc_nbytes=CHUNKS)
        except OSError as error:
            raise DataError(f"{path}: not readable as HDF5 ({plain(error)}); copy it again") from error

    def __contains__(self, place: str) -> bool:
        return place in self._file

    def length(self, place: str) -> int:
        """Return the number of rows of a data set."""
        return int(self._dataset(place).shape[0])

    def shape(self, place: str) -> tuple[int, ...]:
        return tuple(int(n) for n in self._dataset(place).shape)

    def read(self, place: str, row: int | None = None) -> np.ndarray:
        """Return a data set, or one row of it."""
        dataset = self._dataset(place)
        try:
            return np.asarray(dataset[()] if row is None else dataset[row])
        except (OSError, RuntimeError, ValueError) as error:
            raise DataError(f"{self.path}: {place} cannot be read ({plain(error)}); copy it again") from error

    def text(self, place: str) -> str:
        value = self.read(place).ravel()[0]
        return value.decode("latin-1") if isinstance(value, bytes) else str(value)

    def _dataset(self, place: str) -> Any:
        found = self._file.get(place)
        if found is None or not hasattr(found, "shape"):
            there = plain(", ".join(self._file), 100) or "nothing"
            raise DataError(f"{self.path}: expected a data set {place}, got {there} at the top")
        return found

    def times(self, place: str, ticks: float) -> np.ndarray:  # [N] s
        """Return increasing times, `ticks` of them in a second."""
        times = self.read(place).astype(np.float64).ravel() / ticks
        if len(times) == 0 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise DataError(f"{self.path}: {place}: expected increasing times")
        return times

    def depth(self, place: str, row: int, camera: Camera) -> np.ndarray:  # [H, W] float32 m, 0 = missing
        """Return a depth image in metres; NaN, infinity, negative values and 0 are missing."""
        depth = self.read(place, row).astype(np.float32)
        if depth.shape != camera.shape:
            raise DataError(f"{self.path}: {place}: expected {camera.shape} pixels, got {depth.shape}")
        with np.errstate(invalid="ignore"):
            return np.where((depth > 0) & (depth < FARTHEST_DEPTH), depth, np.float32(0))

    def kalibr_lens(self, place: str) -> Lens:
        """Return the lens of a group with Kalibr's intrinsics, distortion and resolution."""
        what = f"{self.path}: {place}"
        fx, fy, cx, cy = numbers(self.read(f"{place}/intrinsics"), 4, f"{what}/intrinsics")
        width, height = numbers(self.read(f"{place}/resolution"), 2, f"{what}/resolution")
        D = numbers(self.read(f"{place}/distortion_coeffs"), (4, 5, 8), f"{what}/distortion_coeffs")
        try:
            camera = Camera(int(width), int(height), float(fx), float(fy), float(cx), float(cy))
        except DataError as error:
            raise DataError(f"{what}: {error}") from error
        return lens_of(self.text(f"{place}/distortion_model"), D, camera, what)


def only_file(folder: Path, pattern: str, what: str) -> Path:
    """Return the one file of a pattern in a folder; refuse none and several."""
    found = sorted(p for p in folder.glob(pattern) if p.is_file())
    if not found:
        raise FileNotFoundError(f"{folder}: {what} not found; expected {pattern}")
    if len(found) > 1:
        raise DataError(
            f"{folder}: {what}: expected one {pattern}, got {found[0].name} and {found[1].name}; "
            "use a folder for each recording"
        )
    return found[0]
