"""Compiled kernels kept between runs, in a folder of ours whose files are checked before they are used.

Taichi trusts its files: a damaged one can end the process while a kernel loads, and the same happens at every
later start. It also ends with a segmentation fault where its folder cannot be written, and does not start
without HOME.

    <cache>/kernels/<engine>-<version>/compiled/        the engine's own files
                                      /checksums.json   {name: SHA-256}, written after the engine's files
                                      /.crash.*         what a process that ended in the engine wrote last
                                      /lock             held while files are checked or written
"""

import atexit
import contextlib
import faulthandler
import gc
import hashlib
import json
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, TextIO

from edslam_ti.cache import cache_folder
from edslam_ti.leftovers import left_behind, remove_leftovers, temporary_name

try:
    import fcntl
except ImportError:  # Windows: processes that start or end in the same moment may remake the cache
    fcntl = None  # type: ignore[assignment]

LONGEST_WAIT = 10.0  # seconds for the lock; a check takes some milliseconds

logger = logging.getLogger(__name__)
_open: "CompiledKernels | None" = None


def home() -> str:
    """Return the user's home folder, or another where there is none: Taichi aborts without HOME."""
    folder = os.path.expanduser("~")
    return folder if os.path.isabs(folder) else tempfile.gettempdir()


@contextlib.contextmanager
def opened(engine: ModuleType) -> Iterator[dict[str, Any]]:
    """Yield the options with which to start the engine; what it compiled before is saved first.

    The engine must be started inside the block. At the end of the process its files are saved.
    """
    global _open
    if _open is None:
        _open = CompiledKernels(engine)
        atexit.register(_close)
    else:
        _open.save()
    with _open.checked():
        # An engine that keeps nothing needs a folder all the same, one that exists.
        folder = _open.files if _open.files.is_dir() else Path(os.sep)
        yield {"offline_cache": _open.files.is_dir(), "offline_cache_file_path": str(folder)}


def _close() -> None:
    if _open is not None and _open.process == os.getpid():  # not in a fork
        _open.save()
        _open.close()


class CompiledKernels:
    """The files of one engine's version, for the time of one process."""

    def __init__(self, engine: ModuleType) -> None:
        version = engine.__version__
        version = version if isinstance(version, str) else ".".join(map(str, version))
        self.process = os.getpid()
        self._engine = engine
        self._folder = cache_folder() / "kernels" / f"{engine.__name__}-{version}"
        self._crash: TextIO | None = None

    @property
    def files(self) -> Path:
        """The folder that the engine writes to."""
        return self._folder / "compiled"

    @contextlib.contextmanager
    def checked(self) -> Iterator[None]:
        """Hold the lock; remove files that are not as they were written, or that a process crashed with."""
        with self._locked():
            if self._has_crashed():
                self._remove("a process crashed while it used them")
            self._check()
            self._watch_crashes()
            yield

    def save(self) -> None:
        """Stop the engine, which writes its files then, and note what they are."""
        with self._locked():
            self._check()  # what was damaged meanwhile must not be noted as right
            self._engine.reset()
            gc.unfreeze()
            gc.collect()  # the engine writes when its last object goes
            with contextlib.suppress(OSError):  # a full disk: the files are removed by the next check
                text = json.dumps(_checksums(self.files))
                temporary = temporary_name(self._sums)
                temporary.write_text(text)
                os.replace(temporary, self._sums)

    def close(self) -> None:
        """Forget the crash that did not come."""
        if self._crash is not None:
            faulthandler.disable()
            self._crash.close()
            Path(self._crash.name).unlink(missing_ok=True)

    @property
    def _sums(self) -> Path:
        return self._folder / "checksums.json"

    def _check(self) -> None:
        try:
            noted = json.loads(self._sums.read_bytes()) if self._sums.exists() else {}
            is_right = (_checksums(self.files) if os.path.lexists(self.files) else {}) == noted
        except (OSError, ValueError, RecursionError):
            is_right = False
        if not is_right:
            self._remove("they are not as they were written")
        with contextlib.suppress(OSError):
            self.files.mkdir(parents=True, exist_ok=True)
            for lock in self.files.rglob(
                "*.lock"
            ):  # of an engine that was killed while it wrote: ours is held
                lock.unlink()

    def _remove(self, reason: str) -> None:
        if os.path.lexists(self.files):
            logger.warning("compiled kernels in %s are made anew: %s", self._folder, reason)
        for path in (self.files, self._sums):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)

    def _has_crashed(self) -> bool:
        """Return whether a process that is no more crashed inside the engine; forget it."""
        crashed = False
        for path in left_behind(self._folder, "crash"):
            with contextlib.suppress(OSError):
                crashed |= f"{os.sep}{self._engine.__name__}{os.sep}" in path.read_text(errors="replace")
        remove_leftovers(self._folder)
        return crashed

    def _watch_crashes(self) -> None:
        """Let Python write down where the process is if it ends in a fatal signal."""
        if self._crash is not None or faulthandler.is_enabled():
            return
        with contextlib.suppress(OSError):
            self._crash = temporary_name(self._folder / "crash").open("w")
            faulthandler.enable(file=self._crash)

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the lock of the folder; without it after a while, for the engine has a lock of its own."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            file = (self._folder / "lock").open("w")
        except OSError:
            yield
            return
        with file:  # closing it unlocks
            end = time.monotonic() + LONGEST_WAIT
            while fcntl is not None and time.monotonic() < end:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    time.sleep(0.01)
                except OSError:  # a file system without locks
                    break
            yield


def _checksums(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file; raise ValueError where there is something else."""
    sums: dict[str, str] = {}
    for entry in os.scandir(folder):
        if entry.is_dir(follow_symlinks=False):
            inner = _checksums(Path(entry.path))
            sums |= {f"{entry.name}/{name}": value for name, value in inner.items()}
        elif not entry.is_file(follow_symlinks=False):
            raise ValueError(f"{entry.path}: expected a file")
        elif not entry.name.endswith(".lock"):
            sums[entry.name] = hashlib.sha256(Path(entry.path).read_bytes()).hexdigest()
    return sums
