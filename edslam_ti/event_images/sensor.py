"""What a recording's events say about its sensor: dead time, noise, hot pixels.

Dead time D. After an event its pixel is blind for D, so no two events of a pixel are nearer than D. A steep
edge, too, gives a shortest interval, that in which brightness changes by a threshold; but then an event
of the other polarity needs about twice as long, because brightness must go back by both thresholds. After a
dead time it needs no longer, because the reference was set anew. So the shortest intervals to an event of the
same and of the other polarity are compared.

Where that leaves a doubt, images decide, if there are any: dead_time.py.

Noise events are alone: their rate is that of events in a pixel whose neighbours are silent, before and after.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

from edslam_ti.datasets.base import EventDepthSequence
from edslam_ti.event_images.dead_time import dead_time_from_images
from edslam_ti.event_images.intervals import intervals
from edslam_ti.event_images.noisy import AROUND, NOISY
from edslam_ti.events import Events

WINDOW = 0.2  # seconds that are looked at without a break
MOST_EVENTS = 600_000  # of a window; it is cut there
NUM_WINDOWS = 8  # spread evenly over the recording
EDGES = np.geomspace(1e-6, 1.0, 241)  # s, of the histograms of intervals
SHORT = 3e-5  # share of the intervals that may be shorter than the shortest one that counts
LEAST_SHORT = 5  # and their least number
LEAST_INTERVALS = 1000  # of either kind
HARD = 2.5  # a limit is one if four times as many intervals are within this many times of it
EQUAL = 1.2  # the two shortest intervals are one, if the other polarity's is within this many times
DOUBTFUL = 2.2  # or perhaps if it is within this many times: images decide
QUIET_BIN = 0.01  # s
QUIET_AROUND = 7  # px, width of the neighbourhood that must be silent, in this bin and those beside it
NOISE_RATE = 0.5  # Hz a pixel; rooms without noise give up to 0.3
HOT_RATE, HOT_EVENTS = 20.0, 20  # Hz and number, at least, of a hot pixel's events


@dataclass(frozen=True)
class SensorEstimate:
    """What the events say about their sensor."""

    num_events: int  # that were looked at
    duration: float  # seconds that were looked at
    positive_share: float  # of the events
    shortest_interval: float | None  # s between events of a pixel; None: too few events
    shortest_by_polarity: tuple[float, float] | None  # s, to an event of the same and of the other polarity
    dead_time: float | None  # s; None: there is no sign of one
    noise_rate: float | None  # Hz a pixel; None: no pixel was quiet for long enough
    noise_positive_share: float | None
    hot_pixels: np.ndarray  # [P, 2] x, y, most active first
    histograms: np.ndarray = field(repr=False)  # [2, 240] intervals to the same and to the other polarity
    numbers: np.ndarray = field(repr=False)  # [H, W] events of each pixel

    def interval_quantile(self, share: float) -> float | None:
        """Return the time (s) that a share of the intervals between a pixel's events stays below."""
        total = np.cumsum(self.histograms.sum(0))
        if total[-1] == 0:
            return None
        return float(EDGES[1:][np.searchsorted(total, share * total[-1])])

    @property
    def is_noisy(self) -> bool:
        """Whether there are more events of quiet pixels than a scene without noise has."""
        return (self.noise_rate or 0.0) > NOISE_RATE

    @property
    def short_share(self) -> float:
        """Share of the intervals shorter than twice the dead time: half the change or more was lost there."""
        if self.dead_time is None or self.histograms.sum() == 0:
            return 0.0
        return float(self.histograms[:, EDGES[1:] <= 2 * self.dead_time].sum() / self.histograms.sum())


@dataclass(frozen=True)
class _Limit:
    """The lower end of a distribution of intervals."""

    shortest: float  # s
    growth: float  # how many times as long are the shortest of four times as many


class SensorStatistics:
    """Gathers what `estimate` needs from stretches of events without a break."""

    def __init__(self, shape: tuple[int, int], where: np.ndarray | None = None) -> None:  # (H, W), [H, W]
        """`where`: pixels whose noise counts; None: all."""
        self._shape, self._where = shape, where
        self._numbers = np.zeros(shape, np.int64)
        self._positive = 0
        self._histograms = np.zeros((2, len(EDGES) - 1), np.int64)
        self._shortest: list[list[np.ndarray]] = [[], []]
        self._duration = self._quiet = 0.0  # s; s of all quiet pixels
        self._alone = np.zeros(2, np.int64)  # events of quiet pixels, darker and brighter

    def add(self, events: Events) -> None:
        """Add a stretch of events."""
        if len(events) < 2:
            return
        height, width = self._shape
        pixel = events.y.astype(np.int64) * width + events.x
        self._numbers += np.bincount(pixel, minlength=height * width).reshape(self._shape)
        self._positive += int((events.polarity > 0).sum())
        self._duration += float(events.t[-1] - events.t[0])
        since, is_same = intervals(events, width)
        for k, chosen in enumerate((is_same, ~is_same)):
            found = since[chosen & np.isfinite(since)]
            self._histograms[k] += np.histogram(found, EDGES)[0]
            least = np.partition(found, min(2000, len(found) - 1))[:2000] if len(found) else found
            self._shortest[k].append(least)
        self._add_quiet(events)

    def _add_quiet(self, events: Events) -> None:
        """Count the events of pixels whose neighbours are silent, and for how long pixels are so."""
        bins = ((events.t - events.t[0]) / QUIET_BIN).astype(np.int64)
        ends = np.searchsorted(bins, np.arange(int(bins[-1]) + 1), side="left")
        images = [_counted(events[a:b], self._shape) for a, b in zip(ends, [*ends[1:]])]  # whole bins
        if len(images) < 3:
            return
        active = [(i.sum(-1) > 0).astype(np.uint8) for i in images]
        kernel = np.ones((QUIET_AROUND, QUIET_AROUND), np.uint8)
        widened = [cv2.dilate(a, kernel) for a in active]
        kernel[QUIET_AROUND // 2, QUIET_AROUND // 2] = 0
        for k in range(1, len(images) - 1):
            around = np.maximum(widened[k - 1], widened[k + 1])
            quiet = np.maximum(around, cv2.dilate(active[k], kernel)) == 0
            quiet = quiet if self._where is None else quiet & self._where
            self._quiet += float(quiet.sum()) * QUIET_BIN
            self._alone += images[k][quiet].sum(0, dtype=np.int64)

    def estimate(self, dead_time: float | None = None) -> SensorEstimate:
        """Return what was found; `dead_time` (s) where it is known better, 0: there is none."""
        count = int(self._numbers.sum())
        same, other = (self._limit(k) for k in (0, 1))
        both = None if same is None or other is None else (same.shortest, other.shortest)
        shortest = None if both is None else min(both)
        if dead_time is None and same is not None and other is not None:
            is_limit = max(same.growth, other.growth) < HARD
            dead_time = shortest if is_limit and other.shortest < EQUAL * same.shortest else None
        alone = self._alone.sum()
        is_known = self._quiet >= 1.0
        return SensorEstimate(
            count,
            self._duration,
            self._positive / max(count, 1),
            shortest,
            both,
            dead_time or None,
            float(alone / self._quiet) if is_known else None,
            float(self._alone[1] / alone) if is_known and alone else None,
            self._hot(),
            self._histograms,
            self._numbers,
        )

    def _limit(self, k: int) -> "_Limit | None":
        """Return the shortest interval of a kind; None: too few intervals."""
        total = int(self._histograms[k].sum())
        if total < LEAST_INTERVALS:
            return None
        least = np.sort(np.concatenate(self._shortest[k]))
        rank = max(LEAST_SHORT, round(SHORT * total))
        rank = min(rank, len(least) // 4 - 1)
        shortest = max(float(least[rank - 1]), 1e-9)
        return _Limit(shortest, float(least[4 * rank - 1]) / shortest)

    def _hot(self) -> np.ndarray:  # [P, 2]
        numbers = self._numbers.astype(np.float32)
        around = cv2.medianBlur(numbers, AROUND)
        least = max(HOT_RATE * self._duration, HOT_EVENTS)
        usual = float(np.percentile(numbers, 90))
        y, x = np.nonzero(numbers > np.maximum(NOISY * np.maximum(around, 0.1 * usual), least))
        order = np.argsort(-numbers[y, x], kind="stable")
        return np.stack([x[order], y[order]], -1)


def _counted(events: Events, shape: tuple[int, int]) -> np.ndarray:  # [H, W, 2] uint8
    counts = np.zeros((*shape, 2), np.uint8)
    np.add.at(counts, (events.y, events.x, (events.polarity > 0).astype(int)), 1)
    return counts


def estimate_from_events(events: Events, shape: tuple[int, int]) -> SensorEstimate:  # (H, W)
    """Return what one stretch of events says."""
    statistics = SensorStatistics(shape)
    statistics.add(events)
    return statistics.estimate()


def estimate_sensor(
    sequence: EventDepthSequence,
    start: float,  # seconds
    end: float,
    where: np.ndarray | None = None,  # [H, W] bool, pixels whose noise counts; None: all
) -> SensorEstimate:
    """Return what the events in [start, end], and the images there, say about the sensor."""
    statistics = SensorStatistics(sequence.camera.shape, where)
    for begin in _window_starts(start, end):
        events = sequence.events(begin, min(begin + WINDOW, end))
        statistics.add(events[:MOST_EVENTS])
    estimate = statistics.estimate()
    if estimate.shortest_by_polarity is None or estimate.shortest_interval is None:
        return estimate
    same, other = estimate.shortest_by_polarity
    if other > DOUBTFUL * same:
        return estimate
    found = dead_time_from_images(sequence, start, end, estimate.shortest_interval)
    if found is None or not found.is_sure:
        return estimate
    return statistics.estimate(found.value)


def _window_starts(start: float, end: float) -> list[float]:
    """Return where windows begin: one after the other in a short recording, else spread evenly."""
    count = min(NUM_WINDOWS, max(1, int((end - start) / WINDOW)))
    return [float(t) for t in np.linspace(start, max(end - WINDOW, start), count)]
