"""The interface of sequences, and their division into samples."""

import inspect
import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.imu import ImuData
from edslam_ti.errors import LONGEST_MESSAGE, DataError, plain
from edslam_ti.events import Events
from edslam_ti.trajectory import Trajectory
from edslam_ti.truth import true_path

T = TypeVar("T")


@dataclass(frozen=True)
class Sample:
    """One step of the main loop: the events since the last step and the depth image at its end."""

    timestamp: float  # seconds from the start of the sequence
    events: Events  # from the last sample's time stamp (included) to this one's (excluded)
    depth: np.ndarray | None  # [H, W] float32 metres, 0 = missing; None between depth images
    image: np.ndarray | None = None  # [H, W] float32 in [0, 1], for evaluation and RGB-D baselines
    T_world_camera: np.ndarray | None = None  # [4, 4] truth, for evaluation only


@dataclass(frozen=True)
class NovelView:
    """A true view from a pose near the path, not on it; for evaluation only."""

    timestamp: float  # seconds, of the path's pose nearby
    image: np.ndarray  # [H, W] float32 in [0, 1]
    depth: np.ndarray  # [H, W] float32 metres, exact, 0 = missing
    T_world_camera: np.ndarray  # [4, 4]


class EventDepthSequence(ABC):
    """Streams of events and depth, with images and true poses if the data has them.

    Recordings of depth cameras alone have no events: `has_events` is False, `events` returns empty slices and
    `time_range` is that of the depth images.

    Constructors validate what they can without reading everything, and raise `DataError` or
    `FileNotFoundError`. Reading methods raise `DataError` for faults that show only then. One unusable image
    must not end a run: `depth_or_none` and `image_or_none` leave it out and add to `notes`.
    """

    dataset: str
    scene: str
    camera: Camera
    contrast_threshold: float | None  # C of Eq. 11 when the data states it
    truth: Trajectory | None  # true poses
    depth_timestamps: np.ndarray  # [D] seconds, strictly increasing
    image_timestamps: np.ndarray  # [I] seconds, strictly increasing; may be empty
    exposure: float | None = None  # seconds over which an image integrates, when the data states it
    preset: str | None = None  # data set whose settings fit the recording; None: those of its own layout
    description: str  # one line about the recording; a stand-in must say that it is one
    surfaces_file: Path | None = None  # true surfaces of a simulated scene, a PLY mesh; for evaluation only
    has_events: bool = True
    num_dropped_events: int = 0  # bad rows of the event file, which were left out
    time_offset: float = 0.0  # seconds to add to get the files' own clock (stamps since the epoch or boot)
    imu: ImuData | None = None  # inertial measurements; nothing uses them yet
    depth_varies: bool = False  # depth images usually show several values: one with a single value is broken

    @cached_property
    def notes(self) -> list[str]:
        """A line for each omission or repair while reading, for the log; wrappers share the list."""
        return []

    def note(self, text: str) -> None:
        """Add a line to `notes` unless it is there already."""
        text = plain(text, LONGEST_MESSAGE)
        if text not in self.notes:
            self.notes.append(text)

    @abstractmethod
    def depth(self, index: int) -> np.ndarray:
        """Return depth image `index` as [H, W] float32 metres, 0 = missing."""

    @abstractmethod
    def image(self, index: int) -> np.ndarray:
        """Return grey image `index` as [H, W] float32 in [0, 1], undistorted."""

    def depth_or_none(self, index: int) -> np.ndarray | None:  # [H, W] float32 metres
        """Return depth image `index`, None with a note where it cannot be read or shows no depth."""
        try:
            depth = self.depth(index)
        except (DataError, OSError) as error:
            self.note(f"no depth at {stamp_text(self, self.depth_timestamps[index])} s: {error}")
            return None
        if self.depth_varies and not has_variation(depth):
            value = float(depth.max())
            what = f"every pixel is {value:.6g} m" if value > 0 else "every pixel is missing"
            self.note(f"no depth at {stamp_text(self, self.depth_timestamps[index])} s: {what}")
            return None
        return depth

    def image_or_none(self, index: int) -> np.ndarray | None:  # [H, W] float32 in [0, 1]
        """Return grey image `index`, None with a note where it cannot be read."""
        try:
            return self.image(index)
        except (DataError, OSError) as error:
            self.note(f"no image at {stamp_text(self, self.image_timestamps[index])} s: {error}")
            return None

    @abstractmethod
    def events(self, start: float, end: float) -> Events:
        """Return the events with start <= t < end, sorted, inside the image, undistorted."""

    @property
    @abstractmethod
    def time_range(self) -> tuple[float, float]:
        """Times of the first and the last event in seconds; of depth images where there are no events."""

    def novel_views(self) -> list[NovelView]:
        """Return the novel views in the order of time; empty if the data has none."""
        return []

    def image_at(self, timestamp: float, tolerance: float = 1e-3) -> np.ndarray | None:
        """Return the image taken within `tolerance` seconds of a time; None: missing or unreadable."""
        if len(self.image_timestamps) == 0:
            return None
        k = int(np.abs(self.image_timestamps - timestamp).argmin())
        return self.image_or_none(k) if abs(self.image_timestamps[k] - timestamp) <= tolerance else None

    def true_pose(self, timestamp: float) -> np.ndarray | None:
        """Return the true pose at a time, None where `true_poses_at` does not know it."""
        return None if self.truth is None else true_path(self.truth).pose_at(timestamp)


def stamp_text(sequence: EventDepthSequence, time: float) -> str:
    """Return a time (s) on the files' own clock, for messages."""
    return f"{time + sequence.time_offset:.6f}"


def has_variation(depth: np.ndarray) -> bool:  # [H, W] m
    """Return whether a depth image shows at least two depths."""
    for part in (depth[::8, ::8], depth):  # a few pixels suffice nearly always
        measured = part[part > 0]
        if measured.size and measured.min() < measured.max():
            return True
    return False


class WrappedSequence(EventDepthSequence):
    """A sequence that wraps another one; subclasses override what they change.

    The constructor copies every attribute of `EventDepthSequence`, so that attributes added later are not
    lost. Methods forward the call, except `image_at` and `true_pose`, which use the wrapper's own data.
    """

    def __init__(self, sequence: EventDepthSequence) -> None:
        self._sequence = sequence
        for name in inspect.get_annotations(EventDepthSequence):
            setattr(self, name, getattr(sequence, name))
        self.notes = sequence.notes

    @property
    def time_range(self) -> tuple[float, float]:
        return self._sequence.time_range

    def depth(self, index: int) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
        return self._sequence.depth(index)

    def image(self, index: int) -> np.ndarray:  # [H, W] float32 in [0, 1]
        return self._sequence.image(index)

    def events(self, start: float, end: float) -> Events:
        return self._sequence.events(start, end)

    def novel_views(self) -> list[NovelView]:
        return self._sequence.novel_views()


FIRST_HISTORY = 0.1  # s of events that the first sample has
MIN_HISTORY = 0.02  # s of events before the first sample, so that its time surface is not empty
ROUNDING = 0.02 + 1e-4  # of the longest interval: 20 Hz in whole milliseconds are at times 51 ms apart
SAME_TIME = 1e-6  # s; float64 seconds since the epoch are multiples of 2.4e-7
MANY_OUTSIDE = 0.1  # a note is made if more than this share of the depth images have no events around them


def times_between(
    a: float,  # seconds, of a sample
    b: float,  # seconds, of the next depth image
    max_interval: float,  # seconds
    has_events: bool,
) -> list[float]:
    """Return the times of the samples after `a` up to `b`: long gaps are divided where events are."""
    pieces = int(np.ceil((b - a) / max_interval - ROUNDING)) if has_events else 1
    return [float(a + (b - a) * k / pieces) for k in range(1, pieces)] + [float(b)]


class Samples(Protocol):
    """What evaluation needs of a run's samples."""

    @property
    def has_depth(self) -> np.ndarray:  # [S] bool
        """Which samples have a depth image that can be compared with the map."""

    def __len__(self) -> int:
        """Return the number of samples."""

    def without_events(self, k: int) -> Sample:
        """Return sample k without its events."""


class SampledSequence:
    """A sequence cut to [start, start + duration] and divided into samples.

    `start` counts from the first event or depth image, whichever is earlier, so that a recording cut out
    of a longer one also starts at 0. A sample ends at every depth image. Gaps longer than `max_interval` are
    divided evenly by samples without depth, unless there are no events to track then. The first sample has
    depth: unusable images before it are skipped. Later unusable images leave their samples without depth.
    """

    def __init__(
        self,
        sequence: EventDepthSequence,
        start: float,
        duration: float | None,
        max_interval: float,
    ) -> None:
        self.sequence = sequence
        first, last = sequence.time_range
        stamps = sequence.depth_timestamps
        begin = min([first, *stamps[:1]]) + start
        end = np.inf if duration is None else begin + duration
        inside = stamps[(stamps >= begin - SAME_TIME) & (stamps <= end + SAME_TIME)]
        if sequence.has_events:  # depth outside the event stream cannot be tracked
            wanted = len(inside)
            inside = inside[inside >= first + MIN_HISTORY - SAME_TIME]
            inside = inside[inside <= last + max_interval + SAME_TIME]
            if wanted - len(inside) > MANY_OUTSIDE * wanted + 2:
                sequence.note(
                    f"{wanted - len(inside)} of {wanted} depth images are not within the events' time, "
                    f"{stamp_text(sequence, first)} to {stamp_text(sequence, last)} s, and are left out"
                )
        while len(inside) > 1 and sequence.depth_or_none(int(np.searchsorted(stamps, inside[0]))) is None:
            inside = inside[1:]
        if len(inside) < 2:
            depth_range = f"{stamps[0]:.3f} to {stamps[-1]:.3f} s" if len(stamps) else "nothing"
            if sequence.notes:
                depth_range += f" ({sequence.notes[-1]})"
            events_range = f"{first:.3f} to {last:.3f} s" if sequence.has_events else "nothing"
            raise DataError(
                f"{sequence.scene}: expected at least 2 depth images between {begin:.3f} s and "
                f"{min(end, last):.3f} s, got {len(inside)}; depth covers {depth_range}, events "
                f"{events_range}; change --start or --duration (counted from the first of them)"
            )
        times, has_depth = [float(inside[0])], [True]
        for a, b in itertools.pairwise(inside):
            between = times_between(a, b, max_interval, sequence.has_events)
            times += between
            has_depth += [False] * (len(between) - 1) + [True]
        self.timestamps = np.array(times)  # [S]
        self.has_depth = np.array(has_depth)  # [S] bool: a depth image exists; it may turn out unusable
        self._depth_index = np.searchsorted(stamps, self.timestamps, side="left")

    def __len__(self) -> int:
        return len(self.timestamps)

    def __iter__(self) -> Iterator[Sample]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, k: int) -> Sample:
        sample = self.without_events(k)
        # The first sample gets some earlier events so that its time surface is not empty.
        previous = float(self.timestamps[k - 1]) if k else sample.timestamp - FIRST_HISTORY
        return replace(sample, events=self.sequence.events(previous, sample.timestamp))

    def as_far_as_readable(self, k: int) -> tuple[Sample, str]:
        """Return sample k without what cannot be read of it, and what that is (nothing: all is there)."""
        try:
            return self[k], ""
        except (DataError, OSError):
            pass
        sequence, t, problems = self.sequence, float(self.timestamps[k]), list[str]()

        def read(part: Callable[[], T], otherwise: T) -> T:
            try:
                return part()
            except (DataError, OSError) as error:
                problems.append(str(error))
                return otherwise

        start, index = float(self.timestamps[k - 1]) if k else t - FIRST_HISTORY, int(self._depth_index[k])
        events = read(lambda: sequence.events(start, t), Events.empty())
        depth = read(lambda: sequence.depth(index) if self.has_depth[k] else None, None)
        image = read(lambda: sequence.image_at(t), None)
        return Sample(t, events, depth, image, sequence.true_pose(t)), "; ".join(problems)

    def without_events(self, k: int) -> Sample:
        """Return sample k without its events, for evaluation."""
        if not 0 <= k < len(self):
            raise IndexError(k)
        t = float(self.timestamps[k])
        return Sample(
            timestamp=t,
            events=Events.empty(),
            depth=self.sequence.depth_or_none(int(self._depth_index[k])) if self.has_depth[k] else None,
            image=self.sequence.image_at(t),
            T_world_camera=self.sequence.true_pose(t),
        )
