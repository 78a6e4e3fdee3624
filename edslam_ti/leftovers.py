"""Temporary names that say which process made them, and the removal of those whose process is dead."""

import hashlib
import os
import re
import shutil
import socket
import uuid
from functools import cache
from pathlib import Path

_NAME = re.compile(
    r"\.(?P<stem>.*)\.(?P<host>[0-9a-f]{8})-(?P<process>\d+)-[0-9a-f]{8}\.(?P<ending>partial|old)"
    r"(?P<suffix>\..*)?",
    re.DOTALL,
)
LONGEST_STEM = 100  # bytes kept of a name: file systems allow 255 for all of it


def temporary_name(path: Path, ending: str = "partial") -> Path:
    """Return an unused hidden name beside `path` with the same suffix: writers choose a format by it.

    An `old` folder is one that was moved away for a new one.
    """
    stem = os.fsdecode(os.fsencode(path.stem if path.suffix else path.name)[:LONGEST_STEM])
    suffix = path.suffix if len(os.fsencode(path.suffix)) <= LONGEST_STEM else ""
    maker = f"{_this_host()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    return path.with_name(f".{stem}.{maker}.{ending}{suffix}")


def remove_leftovers(folder: Path) -> list[Path]:
    """Remove what dead processes of this host left half written in a folder; return what was removed.

    A folder that was moved away for a new one that never came gets its name back. What cannot be read or
    removed stays: it is in nobody's way.
    """
    removed = []
    for match in _of_dead_processes(folder):
        path = folder / match[0]
        place = folder / (match["stem"] + (match["suffix"] or ""))
        try:
            if match["ending"] == "old" and not os.path.lexists(place):
                if len(os.fsencode(match["stem"])) < LONGEST_STEM:  # else its end was cut off
                    os.rename(path, place)
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
        except OSError:  # another process removes it at this moment, or we may not
            continue
        removed.append(path)
    return removed


def left_behind(folder: Path, stem: str) -> list[Path]:
    """Return the temporary files for `stem` in a folder whose process has ended on this host."""
    return [folder / match[0] for match in _of_dead_processes(folder) if match["stem"] == stem]


def _of_dead_processes(folder: Path) -> list[re.Match[str]]:
    try:
        found = [match for name in os.listdir(folder) if (match := _NAME.fullmatch(name))]
    except OSError:
        return []
    return [m for m in found if m["host"] == _this_host() and not _is_running(int(m["process"]))]


@cache
def _this_host() -> str:
    """Return eight digits that stand for the space in which a process number means something.

    Containers count their processes for themselves, also where they share the name of the host.
    """
    try:
        space = os.readlink("/proc/self/ns/pid")
    except OSError:  # not Linux
        space = ""
    return hashlib.sha256(f"{socket.gethostname()} {space}".encode()).hexdigest()[:8]


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # another user's; no number of a process
        return True
    return True
