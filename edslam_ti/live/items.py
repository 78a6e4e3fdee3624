"""What a source hands over, piece by piece, and the interface of sources."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from edslam_ti.datasets.camera_file import CameraFile
from edslam_ti.depth_reprojection import DepthReprojection
from edslam_ti.errors import DataError
from edslam_ti.feeding.intake import DepthUnit, TimeUnit

MOST_WAITING = 256 << 20  # bytes of data that wait to be taken in; then the source waits


@dataclass(frozen=True)
class CameraItem:
    """The camera of all data that follow; comes first."""

    file: CameraFile  # intrinsics, lens, contrast threshold, depth scale
    time_unit: TimeUnit
    depth_unit: DepthUnit = "m"
    initial_pose: np.ndarray | None = None  # [4, 4] T_world_camera of the first frame; None: the identity
    has_events: bool = True
    reprojection: DepthReprojection | None = None  # of depth in another camera; None: pixel for pixel

    def is_same(self, other: "CameraItem") -> bool:
        """Return whether data of both belong to one session; a new first pose makes no difference."""
        mine, theirs = self.file, other.file
        return (mine.camera, mine.lens, mine.depth_undistorted, self.time_unit, self.has_events) == (
            theirs.camera,
            theirs.lens,
            theirs.depth_undistorted,
            other.time_unit,
            other.has_events,
        )


@dataclass(frozen=True)
class EventsItem:
    """Events, in the camera's time unit."""

    x: Any  # [N]
    y: Any  # [N]
    t: Any  # [N]
    p: Any  # [N]


@dataclass(frozen=True)
class DepthItem:
    """A depth image in the camera's depth unit; None: one was taken but cannot be used."""

    t: float
    depth: np.ndarray | None  # [H, W]


@dataclass(frozen=True)
class ImageItem:
    """A grey image."""

    t: float
    image: np.ndarray  # [H, W], or [H, W, 3] RGB


@dataclass(frozen=True)
class TimeItem:
    """All data before this time have been handed over."""

    t: float


@dataclass(frozen=True)
class NoteItem:
    """A line for the user: a connection has begun or ended, a message was refused."""

    text: str


@dataclass(frozen=True)
class EndItem:
    """No data will follow."""


Item = CameraItem | EventsItem | DepthItem | ImageItem | TimeItem | NoteItem | EndItem


class Source(Protocol):
    """Hands over data as they come: a camera, a recording, a connection."""

    description: str  # one line
    is_live: bool  # data come at their own pace, whether or not they are taken in time

    def items(self) -> Iterator[Item]:
        """Yield a `CameraItem`, then data, until the data end; called in a thread of its own.

        A fault of the data is a `NoteItem`, not an exception, where others may follow. Raises `DataError`
        where none can.
        """

    def close(self) -> None:
        """End `items` soon; may be called from any thread, and more than once."""


def size_of(item: Item) -> int:
    """Return about how many bytes an item holds."""
    return sum(value.nbytes for value in vars(item).values() if isinstance(value, np.ndarray)) + 64


@dataclass
class Inbox:
    """Items on their way from a source's thread to the session, a bounded number of bytes."""

    most: int = MOST_WAITING
    clock: Callable[[], float] = time.perf_counter  # seconds
    is_ended: bool = False
    error: Exception | None = None  # what ended the source
    _items: deque[tuple[Item, float]] = field(default_factory=deque)  # and when they came
    _bytes: int = 0
    _changed: threading.Condition = field(default_factory=threading.Condition)

    def put(self, item: Item) -> bool:
        """Add an item; waits while the inbox is full. Return whether more are wanted."""
        came = self.clock()
        with self._changed:
            while self._bytes > self.most and not self.is_ended:
                self._changed.wait()
            if self.is_ended:
                return False
            self._items.append((item, came))
            self._bytes += size_of(item)
            self._changed.notify_all()
            return True

    def take(self, patience: float) -> list[tuple[Item, float]]:
        """Return all items and when they came; where there are none, wait up to `patience` seconds."""
        with self._changed:
            if not self._items and not self.is_ended:
                self._changed.wait(patience)
            taken = list(self._items)
            self._items.clear()
            self._bytes = 0
            self._changed.notify_all()
            return taken

    def end(self, error: Exception | None = None) -> None:
        """Take no more items."""
        with self._changed:
            self.error = self.error or error
            self.is_ended = True
            self._changed.notify_all()

    def fill_from(self, source: Source) -> threading.Thread:
        """Start a thread that puts a source's items here; it ends with the source."""

        def fill() -> None:
            try:
                for item in source.items():
                    if not self.put(item):
                        break
                self.end()
            except (DataError, OSError) as error:
                self.end(error)
            except Exception as error:
                self.end(error)
                raise

        thread = threading.Thread(target=fill, name="source", daemon=True)
        thread.start()
        return thread
