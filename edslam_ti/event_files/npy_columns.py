"""Events as a folder of arrays x.npy, y.npy, t.npy, p.npy."""

from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError, plain
from edslam_ti.event_files.stream import Clock, RawEvents
from edslam_ti.event_files.units import clock_of

NAMES = ("x", "y", "t", "p")


class NpyColumns:
    """Four arrays of one length in a folder. Whole numbers in `t.npy` are microseconds, others seconds."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name = str(path)
        self.size: tuple[int, int] | None = None
        self.notes: list[str] = []
        self._columns = {name: _Column(path / f"{name}.npy") for name in NAMES}
        lengths = {name: len(values) for name, values in self._columns.items()}
        if len(set(lengths.values())) > 1:
            there = ", ".join(f"{name}.npy {length}" for name, length in lengths.items())
            raise DataError(f"{path}: expected arrays of one length, got {there}; copy them again")
        self.clock: Clock = clock_of(self, f"{path / 't.npy'}")

    def __len__(self) -> int:
        return len(self._columns["t"])

    def read(self, start: int, end: int) -> RawEvents:
        return RawEvents(**{name: self._columns[name].read(start, end) for name in NAMES})

    def times(self, start: int, end: int) -> np.ndarray:  # [M]
        return self._columns["t"].read(start, end)

    def near(self, seconds: float) -> int | None:
        return None


def has_columns(folder: Path) -> bool:
    """Return whether a folder holds events as columns."""
    return all((folder / f"{name}.npy").is_file() for name in NAMES)


class _Column:
    """One array. It is read rather than mapped: the pages of a map would count as the process's memory."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            values = np.load(path, mmap_mode="r", allow_pickle=False)
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{path} not found; expected x.npy, y.npy, t.npy and p.npy") from error
        except (OSError, ValueError, EOFError, SyntaxError, TypeError) as error:
            raise DataError(
                f"{path}: not readable as a NumPy .npy file ({plain(error)}); copy or download it again"
            ) from error
        if values.ndim != 1 or values.dtype.kind not in "fiub":
            raise DataError(
                f"{path}: expected one number for each event, got shape {values.shape} of "
                f"{plain(values.dtype)}"
            )
        self._length, self._dtype = len(values), values.dtype
        self._offset = getattr(values, "offset", 0)

    def __len__(self) -> int:
        return self._length

    def read(self, start: int, end: int) -> np.ndarray:
        """Return the numbers start to end."""
        place = self._offset + start * self._dtype.itemsize
        return np.fromfile(self._path, self._dtype, max(0, end - start), offset=place)
