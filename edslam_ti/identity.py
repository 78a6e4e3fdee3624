"""What a run's result depends on: a resumed run must find it as it was."""

import hashlib
import json
import os
import platform
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from edslam_ti import __version__
from edslam_ti.config import Config
from edslam_ti.datasets import find_sequence
from edslam_ti.errors import DataError
from edslam_ti.kernels import engine

# Settings that change no result
HARMLESS = {"checkpoint", "visualize", "viewer", "viewer_address", "viewer_port", "log", "out"}
HASHED = 1 << 20  # bytes at either end of a large file
SHARED = ("*.yaml", "*.json", "*calib*/*.yaml", "*calib*/*.txt")  # in the folder above
TEXT = {".json", ".txt", ".yaml", ".yml", ".csv"}


def identity_of(config: Config) -> dict[str, Any]:
    """Return, as JSON, what the result of a run depends on."""
    settings = config.model_dump(mode="json", exclude=HARMLESS)
    return {
        "version": __version__,
        "engine": engine.ENGINE,
        "settings": _digest(json.dumps(settings, sort_keys=True).encode()),
        "inputs": _inputs(config),
        "machine": {  # results may differ in their last digits
            "processor": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
            "threads of torch": torch.get_num_threads(),
            "libraries": f"numpy {np.__version__}, torch {torch.__version__}, OpenCV {cv2.__version__}",
        },
    }


def compare(before: dict[str, Any], now: dict[str, Any], folder: Path) -> list[str]:
    """Return what may change the last digits of a resumed run's result, a line each.

    Raises DataError for what would make it another run.
    """
    for name, why in (
        ("version", "resume it with that version of the package, or start a new run"),
        ("engine", "set EDSLAM_ENGINE as it was"),
        ("settings", f"{folder / 'config.yaml'} has been changed since; start a new run with it"),
    ):
        if before.get(name) != now[name]:
            got = "" if name == "settings" else f" {now[name]}, and the run began with {before.get(name)}"
            raise DataError(f"{folder}: cannot be resumed with other {name}{got}: {why}")
    earlier = before.get("inputs", {})
    for name in sorted(earlier.keys() | now["inputs"].keys()):
        if earlier.get(name) != now["inputs"].get(name):
            raise DataError(
                f"{folder}: cannot be resumed: {name} of the recording has been changed since the run began; "
                "start a new run"
            )
    machine = before.get("machine", {})
    return [
        f"{name}: {machine.get(name)} before, {value} now: results may differ in the last digits"
        for name, value in now["machine"].items()
        if machine.get(name) != value
    ]


def _inputs(config: Config) -> dict[str, str]:
    """Return a fingerprint of the recording: by file, and by folder for the many files of images."""
    dataset, folder = find_sequence(config)
    if folder is None:
        return {f"{dataset} {config.scene}": __version__}
    prints = _prints(folder)
    if config.depth_dir is not None:
        prints |= {f"depth folder {name}": value for name, value in _prints(config.depth_dir).items()}
    for pattern in SHARED:  # calibration that several recordings share
        for file in sorted(folder.resolve().parent.glob(pattern)):
            if file.is_file():
                prints[f"../{file.relative_to(folder.resolve().parent)}"] = _ends(file, file.stat().st_size)
    return prints


def _prints(folder: Path) -> dict[str, str]:
    """Return a fingerprint of a folder's files."""
    prints: dict[str, str] = {}
    walked: set[str] = set()
    for path, folders, names in os.walk(folder, followlinks=True):
        if os.path.realpath(path) in walked:  # a link to a folder above would never end
            folders.clear()
            continue
        walked.add(os.path.realpath(path))
        folders.sort()
        images = hashlib.blake2b(digest_size=16)
        for name in sorted(names):
            file = Path(path) / name
            try:
                status = file.stat()
                facts = f"{status.st_size} bytes of {status.st_mtime_ns}"
                is_read = file.suffix.lower() in TEXT or status.st_size > HASHED
                if is_read and file.is_file():  # reading a pipe or a device would never end
                    prints[str(file.relative_to(folder))] = f"{facts} {_ends(file, status.st_size)}"
                else:
                    images.update(os.fsencode(f"{name} {facts}\n"))
            except OSError as error:
                images.update(f"{name} {error.strerror}".encode(errors="replace"))
        if names:
            prints[str(Path(path).relative_to(folder))] = images.hexdigest()
    return prints


def _ends(path: Path, size: int) -> str:
    """Return a digest of the first and the last megabyte of a file."""
    with path.open("rb") as file:
        data = file.read(HASHED)
        if size > HASHED:
            file.seek(max(HASHED, size - HASHED))
            data += file.read(HASHED)
    return _digest(data)


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
