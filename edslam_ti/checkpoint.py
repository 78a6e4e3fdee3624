"""Checkpoints of a run: its state in files, from which it goes on as if it had never stopped.

NUMBER.state holds the arrays that changed since the checkpoint before, raw, then JSON that says what they
are part of (object_graph.py) and where the other arrays lie, in files of earlier checkpoints: images that
are kept for long are written once. A file is written under a temporary name, put on the disk, and renamed:
it is there whole or not at all. The last two checkpoints are kept. Every array carries its digest, so that a
damaged file is noticed and the checkpoint before is taken.
"""

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pydantic import BaseModel

from edslam_ti.datasets import EventDepthSequence
from edslam_ti.kernels.depth_average import PixelRays
from edslam_ti.object_graph import Graph, Outside, StateError, from_graph, outside_of, to_graph
from edslam_ti.results.run import Run

MAGIC = b"edslam state 1\n"
SUFFIX = ".state"
ALIGNMENT = 64  # bytes, of arrays in a file
DIGEST = 16  # bytes
KEPT = 2  # checkpoints
SMALLEST_SHARED = 4096  # bytes; smaller arrays are written anew each time
MOST_WASTE = 0.5  # of a file; where more of it is out of date, the rest is written anew, so that it can go
LEAST_PAUSE = 50  # times what a checkpoint took lie between two: they cost 2 % of the time at most


@dataclass(frozen=True)
class _Place:
    """Where the bytes of an array are."""

    number: int  # of the file
    offset: int
    size: int  # bytes


class Checkpoints:
    """The checkpoints in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._places: dict[str, _Place] = {}  # by digest, of the arrays of the last checkpoint
        self._in_use: list[set[int]] = []  # files of the checkpoints that are kept

    def write(self, graph: Graph, about: dict[str, Any]) -> None:
        """Write a checkpoint; `about` is JSON that comes with it."""
        self._folder.mkdir(exist_ok=True)
        number = max(self._numbers(), default=0) + 1
        reusable = self._reusable()
        places: dict[str, _Place] = {}
        arrays: list[list[Any]] = []
        temporary = self._folder / f".{number}.partial"
        try:
            with temporary.open("wb") as file:
                file.write(MAGIC)
                for array in graph.arrays:
                    digest = _digest(array)
                    place = places.get(digest) or reusable.get(digest)
                    if place is None:
                        place = _Place(number, _appended(file, array), array.nbytes)
                    if array.nbytes >= SMALLEST_SHARED:
                        places[digest] = place
                    arrays.append([array.dtype.str, array.shape, place.number, place.offset, digest])
                content = {"about": about, "root": graph.root, "nodes": graph.nodes, "arrays": arrays}
                text = json.dumps(content, separators=(",", ":")).encode()
                file.write(text + hashlib.sha256(text).digest() + len(text).to_bytes(8, "little"))
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, self._path(number))
            _sync_folder(self._folder)
        finally:
            temporary.unlink(missing_ok=True)
        self._places = places
        self._in_use = [*self._in_use, {number, *(place[2] for place in arrays)}][-KEPT:]
        self._remove_unused()

    def newest(self) -> tuple[Graph, dict[str, Any]] | None:
        """Return the newest checkpoint that is whole and what came with it; None: there is none."""
        for partial in self._folder.glob(".*.partial"):  # of a process that was killed
            partial.unlink(missing_ok=True)
        for number in sorted(self._numbers(), reverse=True):
            try:
                content = self._content(number)
                graph = Graph(content["root"], content["nodes"], self._arrays(content["arrays"]))
                about = content["about"]
            except (OSError, ValueError, KeyError, IndexError, TypeError):  # damaged: the one before
                continue
            self._in_use = [{number, *(place[2] for place in content["arrays"])}]
            self._places = {
                digest: _Place(file, offset, graph.arrays[k].nbytes)
                for k, (_, _, file, offset, digest) in enumerate(content["arrays"])
                if graph.arrays[k].nbytes >= SMALLEST_SHARED
            }
            return graph, about
        return None

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:06d}{SUFFIX}"

    def _numbers(self) -> list[int]:
        return [int(p.stem) for p in self._folder.glob(f"*{SUFFIX}") if p.stem.isdecimal()]

    def _reusable(self) -> dict[str, _Place]:
        """Return where the arrays of the last checkpoint are, without files that are mostly out of date."""
        used: dict[int, int] = {}
        for place in self._places.values():
            used[place.number] = used.get(place.number, 0) + place.size
        full = {n for n, size in used.items() if size >= (1 - MOST_WASTE) * self._path(n).stat().st_size}
        return {digest: place for digest, place in self._places.items() if place.number in full}

    def _remove_unused(self) -> None:
        in_use = set().union(*self._in_use)
        for number in self._numbers():
            if number not in in_use:
                self._path(number).unlink(missing_ok=True)

    def _content(self, number: int) -> dict[str, Any]:
        data = np.memmap(self._path(number), np.uint8, mode="r")
        end = len(data) - 8 - hashlib.sha256().digest_size
        length = int.from_bytes(data[-8:].tobytes(), "little")
        text = data[max(0, end - length) : end].tobytes()
        if data[: len(MAGIC)].tobytes() != MAGIC or hashlib.sha256(text).digest() != data[end:-8].tobytes():
            raise StateError(f"{self._path(number)}: damaged")
        content: dict[str, Any] = json.loads(text)
        return content

    def _arrays(self, table: list[list[Any]]) -> list[np.ndarray]:
        """Return the arrays of a checkpoint; raises where a file is missing or damaged."""
        arrays = []
        with contextlib.ExitStack() as stack:
            files: dict[int, BinaryIO] = {}
            for kind, shape, number, offset, digest in table:
                if number not in files:
                    files[number] = stack.enter_context(self._path(number).open("rb"))
                dtype = np.dtype(kind)
                size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
                if dtype.hasobject or size > os.fstat(files[number].fileno()).st_size:
                    raise StateError("damaged")
                files[number].seek(offset)
                array = np.empty(shape, dtype)
                data = np.frombuffer(files[number].read(size), np.uint8)
                array.reshape(-1).view(np.uint8)[:] = data  # raises where there is less
                if _digest(array) != digest:
                    raise StateError("damaged")
                arrays.append(array)
        return arrays


def _bytes(array: np.ndarray) -> Any:
    """Return the memory of a contiguous array."""
    return array.reshape(-1).view(np.uint8).data


def _digest(array: np.ndarray) -> str:
    return hashlib.blake2b(_bytes(array) if array.nbytes else b"", digest_size=DIGEST).hexdigest()


def _appended(file: BinaryIO, array: np.ndarray) -> int:
    """Write an array to the end of a file; return where it begins."""
    file.write(b"\0" * (-file.tell() % ALIGNMENT))
    offset = file.tell()
    if array.nbytes:
        file.write(_bytes(array))
    return offset


def _sync_folder(folder: Path) -> None:
    """Put the names in a folder on the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# --- of a run ---


class Keeper:
    """Writes a run's checkpoints when it is time to, and restores the newest."""

    def __init__(
        self,
        run: Run,
        folder: Path,
        seconds: float,  # between two; 0: none
        clock: Callable[[], float] = time.perf_counter,  # seconds
    ) -> None:
        """Begin with a run whose method is freshly built: that is where what is no state is found again."""
        self._run = run
        self._checkpoints = Checkpoints(folder)
        self._seconds = seconds
        self._clock = clock
        self._next = clock() + seconds
        self._outside: Outside = outside_of(run.slam, _is_outside)
        self._is_possible = seconds > 0
        self.num_written = 0
        self.spent = 0.0  # seconds

    def keep_if_due(self) -> None:
        """Write a checkpoint if the last one is long enough ago."""
        if self._is_possible and self._clock() >= self._next:
            self.keep()

    def keep(self) -> None:
        """Write a checkpoint; a run goes on without where that is impossible, and the log says so."""
        if not self._is_possible:
            return
        started = self._clock()
        try:
            self._checkpoints.write(to_graph(self._state(), self._outside), {})
            self.num_written += 1
        except StateError as error:
            self._is_possible = False
            self._run.note_once(f"no checkpoints: {error}; a resumed run begins with the first frame")
        except OSError as error:
            self._run.note_once(f"a checkpoint could not be written: {error.strerror or error}")
        took = self._clock() - started
        self.spent += took
        self._next = self._clock() + max(self._seconds, LEAST_PAUSE * took)

    def restore(self) -> bool:
        """Give the run the state of the newest checkpoint; return whether there is one."""
        newest = self._checkpoints.newest()
        if newest is None:
            return False
        state, run = from_graph(newest[0], self._outside), self._run
        run.slam = state["slam"]
        run.num_events, run.messages = state["num_events"], state["messages"]
        run.finish_seconds, run.is_refined = state["finish_seconds"], state["is_refined"]
        run.started = time.perf_counter() - state["seconds"]
        return True

    def _state(self) -> dict[str, Any]:
        run = self._run
        return {
            "slam": run.slam,
            "num_events": run.num_events,
            "messages": run.messages,
            "finish_seconds": run.finish_seconds,
            "is_refined": run.is_refined,
            "seconds": time.perf_counter() - run.started,
        }


def _is_outside(value: Any) -> bool:
    return isinstance(value, BaseModel | EventDepthSequence | PixelRays)
