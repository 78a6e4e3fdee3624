"""The frame that tracking and mapping work on; its events are counted once for both."""

import functools
from dataclasses import dataclass

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import Sample
from edslam_ti.depth_images import with_gaps_filled
from edslam_ti.events import Events
from edslam_ti.kernels.dead_time import add_missed_change
from edslam_ti.kernels.time_surface import count_events

EVENTS_AT_ONCE = 1_000_000  # events whose pixel indices are held in memory at once


class EventCounts:
    """Event counts per pixel; the arrays are shared, do not change them."""

    def __init__(
        self,
        events: Events,
        shape: tuple[int, int],  # (H, W)
        missed: np.ndarray | None = None,  # [H, W, 2] float32
    ) -> None:
        self.numbers = np.zeros((*shape, 2), np.int32)  # [H, W, 2] of negative and positive events
        # [H, W, 2] thresholds that brightness fell and rose by in dead time; None: the sensor has none
        self.missed = missed
        self.last = np.zeros(shape, np.int8)  # [H, W] polarity of the last event, 0 where there was none
        count_events(events.x, events.y, events.polarity, self.numbers, self.last)
        self._events = events

    @functools.cached_property
    def first(self) -> np.ndarray:  # [H, W] int8
        """Polarity of the first event, 0 where there was none."""
        first = np.zeros_like(self.last)
        for events in reversed(list(self._events.pieces(EVENTS_AT_ONCE))):
            pixel = events.y.astype(np.int64) * first.shape[1] + events.x
            first.ravel()[pixel[::-1]] = events.polarity[::-1]  # repeated pixels keep the value assigned last
        return first


class MissedChange:
    """The change that a sensor with dead time has missed (kernels/dead_time.py), chunk by chunk."""

    def __init__(self, shape: tuple[int, int], dead_time: float) -> None:  # seconds
        self._dead_time = dead_time
        self._last = np.full(shape, -np.inf)  # seconds, of the last event
        self._last_polarity = np.zeros(shape, np.int8)
        self._rate = np.zeros(shape, np.float32)  # thresholds missed before the last event

    def of(self, events: Events) -> np.ndarray:  # [H, W, 2] float32
        """Return what was missed up to each of the next events, in thresholds by polarity."""
        missed = np.zeros((*self._last.shape, 2), np.float32)
        add_missed_change(
            events.x, events.y, events.t, events.polarity, self._dead_time,
            self._last, self._last_polarity, self._rate, missed,
        )  # fmt: skip
        return missed


@dataclass(frozen=True)
class Frame:
    """An event chunk and the depth and image at its end: all data that tracking and mapping get."""

    timestamp: float  # seconds
    previous_timestamp: float  # seconds, start of its event chunk
    events: Events  # of its chunk
    camera: Camera
    depth: np.ndarray | None  # [H, W] float32 metres, 0 = missing
    image: np.ndarray | None  # [H, W] float32 in [0, 1]; only RGB-D baselines use it
    is_held_out: bool = False  # reserved for evaluation, not used for mapping
    missed: np.ndarray | None = None  # [H, W, 2] float32 thresholds, missed in dead time (EventCounts)

    @functools.cached_property
    def tracked_depth(self) -> np.ndarray | None:  # [H, W] float32 metres, 0 = missing
        """Depth as trackers see it: of sparse depth (lidar lines), gaps on one surface are filled."""
        return None if self.depth is None else with_gaps_filled(self.depth)

    @functools.cached_property
    def event_counts(self) -> EventCounts:
        """The chunk's events per pixel (Eq. 11), counted on first access."""
        return EventCounts(self.events, self.camera.shape, self.missed)


class FrameBuilder:
    """Turns samples into frames; they must come in order of time."""

    def __init__(self, camera: Camera, dead_time: float = 0.0) -> None:  # seconds
        self._camera = camera
        self._previous: float | None = None
        self._missed = MissedChange(camera.shape, dead_time) if dead_time > 0 else None

    def build(self, sample: Sample, is_held_out: bool = False) -> Frame:
        """Return the frame at the end of the sample."""
        start = sample.timestamp if self._previous is None else self._previous
        self._previous = sample.timestamp
        return Frame(
            timestamp=sample.timestamp,
            previous_timestamp=start,
            events=sample.events,
            camera=self._camera,
            depth=sample.depth,
            image=sample.image,
            is_held_out=is_held_out,
            missed=None if self._missed is None else self._missed.of(sample.events),
        )
