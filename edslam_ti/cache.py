"""Where generated data is kept between runs: the environment's EDSLAM_CACHE, else the user's cache folder."""

import atexit
import logging
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

import platformdirs

logger = logging.getLogger(__name__)


def chosen_folder() -> Path | None:
    """Return the folder that is asked for, which may not exist; None where the user has no home."""
    if os.environ.get("EDSLAM_CACHE"):
        return Path(os.environ["EDSLAM_CACHE"]).absolute()
    try:
        folder = Path(platformdirs.user_cache_dir("edslam_ti"))
    except (RuntimeError, KeyError, OSError):  # no HOME, and no entry for the user either
        return None
    return folder if folder.is_absolute() else None


def writable_folder() -> Path | None:
    """Return the folder that is asked for, made and tested; None where it cannot be written."""
    folder = chosen_folder()
    return folder if folder is not None and _can_be_written(folder) else None


def cache_folder() -> Path:
    """Return a folder that can be written.

    Where the one asked for cannot, it is one for this process alone, removed at its end: a log line says so.
    """
    folder = writable_folder()
    return _own_folder(chosen_folder()) if folder is None else folder


def cached(entry: Path) -> Path:
    """Return where an entry of the cache is, or is to be made; a read-only cache still gives what it has."""
    folder = chosen_folder()
    if folder is not None and os.path.lexists(folder / entry):
        return folder / entry
    return cache_folder() / entry


@cache
def _own_folder(unusable: Path | None) -> Path:
    try:
        folder = Path(tempfile.mkdtemp(prefix="edslam_ti-"))
    except OSError:  # nowhere: let the one who writes fail at the place that was asked for
        return unusable or Path(os.sep)
    process = os.getpid()

    def remove() -> None:
        if os.getpid() == process:  # not in a fork
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    reason = "the user has no home folder" if unusable is None else f"{unusable} cannot be written"
    logger.warning(
        "cache: %s, so what is made now is lost at the end; EDSLAM_CACHE=FOLDER keeps it elsewhere", reason
    )
    return folder


def _can_be_written(folder: Path) -> bool:
    """Return whether a file can be made in a folder; the folder is made first."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
