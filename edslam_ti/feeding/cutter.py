"""Cuts streams that are still coming in into samples, where `SampledSequence` would cut the recording."""

import bisect
import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from edslam_ti.datasets import Sample
from edslam_ti.datasets.base import FIRST_HISTORY, MIN_HISTORY, SAME_TIME, times_between
from edslam_ti.events import Events
from edslam_ti.feeding.intake import Counts

SAME_MOMENT = 1e-3  # s between a sample and its grey image
LONGEST_GAP = 60.0  # s between two depth images that is still divided into samples
MOST_WAITING = 30_000_000  # events that are kept while a depth image is waited for: 400 MB


@dataclass(frozen=True)
class Cut:
    """A sample, how it was cut."""

    sample: Sample
    depth_number: int | None  # from 0, of the depth image that it ends at; None: it ends between two
    num_merged: int = 0  # samples that were merged into it


class EventQueue:
    """Events that wait for their sample; they may come in any order."""

    def __init__(self) -> None:
        self.newest = -math.inf  # seconds
        self.oldest = math.inf  # that ever came
        self.number = 0
        self._parts: list[Events] = []
        self._is_sorted = True

    def add(self, events: Events) -> None:
        """Add events that are in the order of time among themselves."""
        if len(events) == 0:
            return
        first, last = float(events.t[0]), float(events.t[-1])
        self._is_sorted &= not self._parts or first >= float(self._parts[-1].t[-1])
        self._parts.append(events)
        self.number += len(events)
        self.newest, self.oldest = max(self.newest, last), min(self.oldest, first)

    def between(self, start: float, end: float) -> Events:
        """Return the events with start <= t < end, in the order of time, and of arrival at the same time."""
        return self._whole().between(start, end)

    def drop_before(self, time: float) -> None:
        """Forget the events with t < time."""
        whole = self._whole()
        kept = whole[int(np.searchsorted(whole.t, time)) :]
        if len(kept) < len(whole) // 2:  # let go of the memory of what is gone
            kept = Events(*(a.copy() for a in (kept.x, kept.y, kept.t, kept.polarity)))
        self._parts, self.number = ([kept] if len(kept) else []), len(kept)

    def _whole(self) -> Events:
        whole = Events.concatenate(self._parts)
        if not self._is_sorted:
            whole = whole[np.argsort(whole.t, kind="stable")]
        self._parts, self._is_sorted = ([whole] if len(whole) else []), True
        return whole


class SampleCutter:
    """Collects events, depth and images, and returns samples once all their data are known.

    A sample ends at every depth image. Gaps longer than `max_interval` are divided evenly, so they wait for
    the depth image at their end. The data before a time t are known when an event at or after t + `reorder`
    has come. One stream waits for the other `patience` seconds of data. Then depth is taken for missing until
    it returns, and samples without it follow every `max_interval`; or events are taken for missing.
    """

    def __init__(
        self,
        max_interval: float,  # seconds
        has_events: bool,
        needs_images: bool,
        reorder: float,  # seconds
        patience: float,  # seconds
        counts: Counts,
    ) -> None:
        self._max_interval, self._has_events, self._needs_images = max_interval, has_events, needs_images
        self._reorder, self._patience = reorder, patience
        self._counts = counts
        self.queue = EventQueue()
        self.depths: list[tuple[float, np.ndarray | None]] = []  # waiting, in the order of time
        self.images: list[tuple[float, np.ndarray]] = []  # in the order of time
        self.previous: float | None = None  # time of the last sample
        self.newest_depth = self.newest_image = -math.inf  # seconds
        self._known_until = -math.inf  # seconds; stated by `flush`
        self._forgotten = -math.inf  # seconds; events before are gone
        self._depth_is_missing = False
        self._planned: deque[tuple[float, np.ndarray | None, bool]] = deque()  # bool: a depth image is there
        self._num_depths = 0  # of samples that have been cut
        self.gaps_not_divided = 0

    # --- what comes in ---

    def add_events(self, events: Events) -> None:
        """Add events in the order of time; those of samples that are done are counted and left out."""
        if self.previous is not None and len(events) and events.t[0] < self.previous:
            first = int(np.searchsorted(events.t, self.previous))
            self._counts.events_late += first
            events = events[first:]
        self.queue.add(events)

    def add_depth(self, time: float, depth: np.ndarray | None) -> None:  # s, [H, W] m; None: not usable
        """Add a depth image; one that is not newer than the last sample is counted and left out."""
        self._counts.depth_images += 1
        planned = self._planned[-1][0] if self._planned else -math.inf
        if self.previous is not None and time <= max(self.previous, planned):
            self._counts.depth_late += 1
            return
        at = bisect.bisect_left(self.depths, time, key=lambda pair: pair[0])
        if at < len(self.depths) and self.depths[at][0] == time:
            self._counts.depth_repeated += 1
            return
        self.depths.insert(at, (time, depth))
        self.newest_depth = max(self.newest_depth, time)
        self._depth_is_missing = False

    def add_image(self, time: float, image: np.ndarray) -> None:  # s, [H, W] in [0, 1]
        """Add a grey image."""
        self._counts.images += 1
        self.images.insert(bisect.bisect_right(self.images, time, key=lambda pair: pair[0]), (time, image))
        self.newest_image = max(self.newest_image, time)

    def flush(self, until: float) -> None:
        """State that all data before a time (s) have been added."""
        self._known_until = max(self._known_until, until)

    def finish(self) -> None:
        """State that all data have been added; depth long after the last event cannot be tracked."""
        self.flush(math.inf)
        if self._has_events:
            last = self.queue.newest + self._max_interval + SAME_TIME
            self.depths = [pair for pair in self.depths if pair[0] <= last]

    @property
    def newest(self) -> float:
        """Newest stamp of all data, seconds; -inf: there are none."""
        return max(self.queue.newest, self.newest_depth, self.newest_image)

    @property
    def clock(self) -> float:
        """Time (s) up to which all data are known."""
        own = self.queue.newest if self._has_events else self.newest_depth
        return max(self._known_until, own - self._reorder, self.newest_depth - self._patience)

    # --- what goes out ---

    def next_times(self, is_all: bool = False) -> list[float]:
        """Return the times (s) of the samples that can be cut now: to the next depth image, or `is_all`."""
        if not self._planned and self.previous is None:
            self._plan_first()
        while is_all or not self._planned:
            number, last = len(self._planned), self._planned[-1][0] if self._planned else self.previous
            if last is not None:
                self._plan_after(last)
            if len(self._planned) == number:
                break
        return [time for time, _, _ in self._planned]

    def cut(self, number: int = 1) -> Cut:
        """Return the next sample of `next_times`, or up to `number` as one.

        It ends with the last of them that has depth, where one has.
        """
        planned = list(self._planned)[:number]
        ends = [k for k, (_, depth, _) in enumerate(planned) if depth is not None]
        number = ends[-1] + 1 if ends else len(planned)
        taken = [self._planned.popleft() for _ in range(number)]
        time, depth, is_depth = taken[-1]
        self._num_depths += sum(is_depth for _, _, is_depth in taken)
        start = time - FIRST_HISTORY if self.previous is None else self.previous
        events = self.queue.between(start, time)
        self.queue.drop_before(time)
        self.previous = time
        image = self._image_at(time)
        kept = bisect.bisect_left(self.images, time - SAME_MOMENT, key=lambda pair: pair[0])
        self.images = self.images[kept:]
        return Cut(Sample(time, events, depth, image), self._num_depths - 1 if is_depth else None, number - 1)

    def _plan_first(self) -> None:
        while self.depths and self._is_known(self.depths[0][0]):
            time, depth = self.depths.pop(0)
            earliest = self.queue.oldest + MIN_HISTORY - SAME_TIME if self._has_events else -math.inf
            is_early = time < max(earliest, self._forgotten + FIRST_HISTORY)
            if not is_early and depth is not None:
                self._planned.append((time, depth, True))
                return
            self._counts.depth_early += int(is_early)
        if not self.depths and self._patience < math.inf:  # events alone do not begin
            self._forgotten = max(self._forgotten, self.clock - self._patience - FIRST_HISTORY)
        if not self.depths and self.queue.number > MOST_WAITING:
            self._forgotten = max(self._forgotten, self.queue.newest - FIRST_HISTORY)
        if self.queue.number and self.queue.oldest < self._forgotten:
            self.queue.drop_before(self._forgotten)

    def _plan_after(self, previous: float) -> None:
        if self.depths and self._is_known(self.depths[0][0]):
            time, depth = self.depths.pop(0)
            if time - previous > LONGEST_GAP:
                self.gaps_not_divided += 1
                self._planned.append((time, depth, True))
                return
            times = times_between(previous, time, self._max_interval, self._has_events)
            self._planned.extend((t, None, False) for t in times[:-1])
            self._planned.append((time, depth, True))
            return
        is_late = self.clock < math.inf and self.clock - previous > self._patience
        self._depth_is_missing |= is_late or self.queue.number > MOST_WAITING
        after = previous + self._max_interval
        nearest = self.depths[0][0] if self.depths else self.newest
        if self._has_events and self._depth_is_missing and after <= min(self.clock, nearest):
            self._planned.append((after, None, False))

    def _is_known(self, time: float) -> bool:
        is_seen = not self._needs_images or self.newest_image >= time - SAME_MOMENT
        return time <= self.clock and (is_seen or self._known_until >= time)

    def _image_at(self, time: float) -> np.ndarray | None:  # [H, W]
        if not self.images:
            return None
        nearest, image = min(self.images, key=lambda pair: abs(pair[0] - time))
        return image if abs(nearest - time) <= SAME_MOMENT else None
