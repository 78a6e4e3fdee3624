"""Atomic outputs: files and folders are written under a temporary name, then renamed.

Also the header of a .npy file whose number of rows is known only at the end.
"""

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to `path` (same suffix); rename it to `path` if the block succeeds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}.partial{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder next to `path`; rename it to `path` if the block succeeds.

    An existing folder at `path` is replaced; on an exception it stays unchanged.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
    temporary.mkdir()
    try:
        yield temporary
        if path.exists():
            old = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.old")
            os.replace(path, old)
            os.replace(temporary, path)
            shutil.rmtree(old)
        else:
            os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_npy_header(file: BinaryIO, dtype: np.dtype, num_rows: int, num_columns: int) -> None:
    """Write the header of an array [num_rows, num_columns] at the start of a .npy file.

    Append rows after it. NumPy pads the header, so a later call with the true number of rows takes the same
    space.
    """
    file.seek(0)
    header = {"descr": dtype.str, "fortran_order": False, "shape": (num_rows, num_columns)}
    np.lib.format.write_array_header_1_0(file, header)
