"""Atomic outputs: files and folders are written under a temporary name, then renamed.

Also the header of a .npy file whose number of rows is known only at the end.
"""

import ctypes
import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.leftovers import remove_leftovers, temporary_name

WhyKeep = Callable[[Path], str | None]  # why an existing folder must stay; None: it may be replaced

_CURRENT_FOLDER, _EXCHANGE = -100, 2  # Linux's AT_FDCWD and RENAME_EXCHANGE


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` (same suffix); rename it to `path` when the block ends well.

    What dead processes left half written in the same folder is removed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)
    temporary = temporary_name(path)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path, why_keep: WhyKeep | None = None) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; rename it to `path` when the block ends well.

    `path` must not exist, or be an empty folder, or one for which `why_keep` returns None. Anything else
    stays untouched and raises `DataError`, before the block or, where it appeared meanwhile, after it. The
    old folder stays until the new one takes its place: in one step on Linux, where the file system can
    exchange two names. What dead processes left half written in the same folder is removed.
    """
    check_replaceable(path, why_keep)
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)
    temporary = temporary_name(path)
    temporary.mkdir()
    made = temporary.stat().st_ino
    try:
        yield temporary
        _put_in_place(temporary, path, why_keep)
    finally:
        # After an exchange the temporary name is that of the old folder, which may be another process's.
        if temporary.is_dir() and (temporary.stat().st_ino == made or _is_ours(temporary, why_keep)):
            shutil.rmtree(temporary, ignore_errors=True)


def title_of(folder: Path, length: int) -> str:
    """Return how the README.txt of a folder begins, `length` characters; nothing where there is none."""
    try:
        with (folder / "README.txt").open("rb") as file:
            return file.read(length).decode(errors="replace")
    except OSError:
        return ""


def check_replaceable(path: Path, why_keep: WhyKeep | None = None) -> None:
    """Raise `DataError` unless a new folder may take the place of what is at `path`; see `atomic_folder`."""
    if path.name in ("", ".."):
        raise DataError(f"'{path}': expected the name of a new folder; nothing was written")
    if path.is_symlink():
        raise DataError(f"{path}: is a link; expected a new or an empty folder; nothing was changed")
    if not path.exists():
        return
    if not path.is_dir():
        raise DataError(f"{path}: is a file; expected a new or an empty folder; nothing was changed")
    if not _is_ours(path, why_keep):
        reason = f"holds '{next(path.iterdir()).name}'" if why_keep is None else why_keep(path)
        raise DataError(f"{path}: {reason}; expected a new or an empty folder; nothing was changed")


def _is_ours(folder: Path, why_keep: WhyKeep | None) -> bool:
    return not any(folder.iterdir()) or (why_keep is not None and why_keep(folder) is None)


def _put_in_place(new: Path, path: Path, why_keep: WhyKeep | None) -> None:
    """Rename a folder to `path`; an old one there that may be replaced gets the name `new`, or goes."""
    while True:
        check_replaceable(path, why_keep)
        try:
            os.rename(new, path)  # fails where there is more than an empty folder
            return
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        if not _exchange(new, path):
            _replace_in_two_steps(new, path, why_keep)
            return
        if _is_ours(new, why_keep):
            return
        _exchange(new, path)  # what came between check and exchange is not ours: back with it


def _exchange(first: Path, second: Path) -> bool:
    """Let two existing names change places in one step; return False where the system cannot."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):  # not Linux
        return False
    here = ctypes.c_int(_CURRENT_FOLDER)
    names = [ctypes.c_char_p(os.fsencode(path)) for path in (first, second)]
    if rename(here, names[0], here, names[1], ctypes.c_uint(_EXCHANGE)) == 0:
        return True
    number = ctypes.get_errno()
    if number in (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP):
        return False
    raise OSError(number, os.strerror(number), str(second))


def _replace_in_two_steps(new: Path, path: Path, why_keep: WhyKeep | None) -> None:
    old = temporary_name(path, "old")
    os.rename(path, old)
    try:
        if not _is_ours(old, why_keep):
            raise DataError(f"{path}: another process has just written there; nothing was changed")
        os.rename(new, path)
    except BaseException:
        os.rename(old, path)
        raise
    shutil.rmtree(old)


def write_npy_header(file: BinaryIO, dtype: np.dtype, num_rows: int, num_columns: int | None) -> None:
    """Write the header of an array [num_rows, num_columns], None: [num_rows], at the start of a .npy file.

    Append rows after it. NumPy pads the header, so a later call with the true number of rows takes the same
    space.
    """
    file.seek(0)
    shape = (num_rows,) if num_columns is None else (num_rows, num_columns)
    header = {"descr": dtype.str, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
