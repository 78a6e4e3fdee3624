"""The folder of one run: made before its first frame, by one process alone, marked until it is finished."""

import contextlib
import errno
import fcntl
import json
import os
import shutil
from datetime import datetime
from pathlib import Path
from typing import Any

from edslam_ti import __version__
from edslam_ti.errors import DataError
from edslam_ti.output import atomic_file

RUNNING, FINISHED, INTERRUPTED, FAILED = "running", "finished", "interrupted", "failed"  # states in run.json
STATE, LOCK, SETTINGS, CHECKPOINTS = "run.json", ".lock", "config.yaml", "checkpoint"
FED = "fed"  # in the identity of a run whose data came from a session


class RunFolder:
    """A folder that belongs to this process as long as it is open."""

    def __init__(self, path: Path, lock: int, made: list[Path]) -> None:
        self.path = path
        self._lock = lock  # file descriptor
        self._made = made  # folders that were not there before, the outermost first
        self.identity: dict[str, Any] = {}  # what the run's result depends on

    @classmethod
    def make(cls, parent: Path) -> "RunFolder":
        """Make a new folder named after the time, numbered where several runs begin in one second."""
        made = [p for p in reversed([parent, *parent.parents]) if not p.exists()]
        try:
            parent.mkdir(parents=True, exist_ok=True)
        except OSError:
            _remove_empty(made)
            raise
        name, k = datetime.now().strftime("%Y-%m-%d_%H-%M-%S"), 1
        while True:
            path = parent / (name if k == 1 else f"{name}-{k}")
            try:
                os.mkdir(path)
                break
            except FileExistsError:
                k += 1
        return cls(path, _locked(path), made)

    @classmethod
    def reopen(cls, path: Path) -> "RunFolder":
        """Open the folder of a run that has not finished; raises `DataError` for any other folder."""
        path = path.resolve()  # `latest` may point elsewhere tomorrow
        if read_state(path) is None or not (path / SETTINGS).is_file():
            raise DataError(
                f"{path}: expected the folder of a run that was cut off, found no {STATE} or no {SETTINGS} "
                "in it"
            )
        folder = cls(path, _locked(path), [])
        state = read_state(path) or {}
        if state.get("state") == FINISHED:
            shutil.rmtree(folder.checkpoints, ignore_errors=True)  # it was cut off just before it did so
            folder.close()
            raise DataError(f"{path}: this run has finished; there is nothing to resume")
        folder.identity = state.get("identity") or {}
        if folder.identity.get(FED):
            folder.close()
            raise DataError(f"{path}: the data of a session cannot be read again, so it cannot be resumed")
        for partial in path.rglob(".*.partial*"):  # of files that the process that was cut off did not finish
            partial.unlink(missing_ok=True)
        return folder

    @property
    def checkpoints(self) -> Path:
        """Where checkpoints lie until the run has finished."""
        return self.path / CHECKPOINTS

    def write(self, name: str, text: str) -> None:
        """Write a text file, whole or not at all."""
        with atomic_file(self.path / name) as temporary:
            temporary.write_text(text, encoding="utf-8", errors="backslashreplace")

    def set_state(self, state: str) -> None:
        """Write down how far the run is."""
        about = {
            "state": state,
            "version": __version__,
            "process": os.getpid(),
            "identity": self.identity,
        }
        self.write(STATE, json.dumps(about, indent=2) + "\n")

    def finish(self) -> None:
        """Mark the run as finished; once its results are on the disk, its checkpoints go."""
        for path in (*self.path.glob("*.*"), self.path):
            if path.is_file() or path == self.path:
                descriptor = os.open(path, os.O_RDONLY)
                try:
                    os.fsync(descriptor)
                finally:
                    os.close(descriptor)
        self.set_state(FINISHED)
        shutil.rmtree(self.checkpoints, ignore_errors=True)

    def close(self) -> None:
        """Let other processes open the folder."""
        if self._lock >= 0:
            (self.path / LOCK).unlink(missing_ok=True)
            os.close(self._lock)
            self._lock = -1

    def discard(self) -> None:
        """Remove the folder, and those above it that were made for it: there is nothing to keep."""
        self.close()
        shutil.rmtree(self.path, ignore_errors=True)
        _remove_empty(self._made)


def _remove_empty(folders: list[Path]) -> None:
    for path in reversed(folders):
        with contextlib.suppress(OSError):  # another run has begun in it
            path.rmdir()


def read_state(path: Path) -> dict[str, Any] | None:
    """Return what run.json of a folder says, None where there is none that can be read."""
    try:
        state = json.loads((path / STATE).read_text())
    except (OSError, ValueError, RecursionError):
        return None
    return state if isinstance(state, dict) else None


def is_unfinished(path: Path) -> bool:
    """Return whether a folder is of a run that was cut off or still goes on."""
    state = read_state(path)
    return state is not None and state.get("state") not in (FINISHED, INTERRUPTED)


def point_latest_to(path: Path) -> str:
    """Point `latest` beside a folder to it; return why that was not possible, or nothing."""
    link = path.parent / "latest"
    if link.is_dir() and not link.is_symlink():
        return f"{link} is a folder and stays as it is; it does not point to this run"
    temporary = path.parent / f".latest.{os.getpid()}"
    temporary.unlink(missing_ok=True)
    try:
        temporary.symlink_to(path.name, target_is_directory=True)
        os.replace(temporary, link)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        return f"{link} does not point to this run: {error.strerror or error}"
    return ""


def _locked(path: Path) -> int:
    """Return an open lock file that no other process has; raises `DataError` where one has it."""
    while True:
        lock = os.open(path / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(lock), os.stat(path / LOCK)):
                break
            os.close(lock)  # its owner has just removed it
        except FileNotFoundError:
            os.close(lock)
        except OSError as error:
            owner = os.pread(lock, 20, 0).decode(errors="replace").strip()
            os.close(lock)
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                raise
            raise DataError(f"{path}: another process ({owner or 'unknown'}) is writing this run") from error
    os.ftruncate(lock, 0)
    os.pwrite(lock, f"{os.getpid()}\n".encode(), 0)
    return lock
