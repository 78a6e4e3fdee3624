"""The contrast threshold C of Eq. 11, estimated from grey images where the data states none.

Events alone do not determine it: if all log brightness and C are multiplied by one factor, the events are the
same. (Renders are then right up to that factor, which a fit of slope and offset in log brightness removes.)
A few grey images determine it: between two of them, log brightness at every pixel changes by

    y = C+ p - C- n + error        p, n: positive and negative events in between

Both sides are noisy: p and n because of the remainder since the last event and of noise events, y because of
image noise. Least squares of y on p, n gives too small a C; of p, n on y, too large a C. The sums of p and n
over the surrounding pixels have independent noise, so they serve as instruments Z (Wald 1940):
(C+, C-) = (Z^T X)^-1 Z^T y with X = [p, -n]. There is no constant term: a scene as a whole does not become
brighter, which determines C+ / C- where a sensor has noise events.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from edslam_ti.datasets.base import EventDepthSequence
from edslam_ti.event_images.change import AVERAGE_BIAS
from edslam_ti.events import Events
from edslam_ti.frame import EventCounts, MissedChange

DEFAULT = 0.1  # Sec. IV-A: 0.1 synthetic, 0.2 real
GAPS = (1, 2, 4)  # difference of the indices of a pair of images
MAX_PAIRS = 8  # of each gap
SIGN_PAIRS = 2  # of each gap, where only the sign is asked for: the data state the threshold
LONGEST_PAIR = 0.3  # seconds between the two
DARKEST, BRIGHTEST = 0.1, 0.98  # range of grey values with enough of the 8 bits and without clipping
MIN_EVENTS = 400  # of either polarity
HISTORY = 0.3  # seconds before a pair that are searched for the last event of a pixel
MIN_DIFFERENCE = 0.05  # relative, of C+ and C-; smaller differences are within the errors of the estimate
LOG_EPSILON = 0.004
# Both thresholds are negative by so many standard deviations (at least so large a one) where events say
# brighter and images darker.
SURELY_INVERTED, LEAST_DEVIATION = 3.0, 0.005
RING = 5  # px; pixels of this square around a pixel, without the inner 3 x 3, are its instruments


@dataclass(frozen=True)
class ContrastThreshold:
    """C and its source."""

    value: float
    source: str  # "settings", "data", "images" or "default"
    positive: float | None = None
    negative: float | None = None
    deviation: float | None = None  # standard deviation of `value` among the pairs of images (jackknife)
    notes: tuple[str, ...] = ()  # what looks wrong with the events, a line each
    dead_time: float = 0.0  # seconds after an event in which its pixel is blind
    start_bias: float = 0.0  # thresholds that brightness is beyond the references at the start, on average
    has_faults: bool = False  # the events show dead time or noise
    deviations: tuple[float, float] | None = None  # the same of `positive` and `negative`

    @property
    def relative(self) -> tuple[float, float]:
        """Return the positive and the negative threshold divided by `value`; 1 unless they differ."""
        if self.positive is None or self.negative is None:
            return 1.0, 1.0
        if abs(self.positive - self.negative) < MIN_DIFFERENCE * self.value:
            return 1.0, 1.0
        return self.positive / self.value, self.negative / self.value

    @property
    def by_polarity(self) -> tuple[float, float]:
        """Return the positive and the negative threshold; `value` both unless they differ."""
        positive, negative = self.relative
        return self.value * positive, self.value * negative


def contrast_threshold(
    stated: float | None,  # by the settings
    sequence: EventDepthSequence,
    start: float,  # seconds
    end: float,
    dead_time: float = 0.0,  # seconds
) -> ContrastThreshold:
    """Return the threshold that the settings or the data state, else an estimate, else the default.

    The settings state the mean; the ratio C+ / C- is estimated nevertheless.
    """
    in_data = sequence.contrast_threshold if stated is None else None
    max_pairs = MAX_PAIRS if in_data is None else SIGN_PAIRS
    solution = _from_images(sequence, start, end, max_pairs, dead_time)
    notes = solution.notes if solution else ()
    if in_data is not None:
        return ContrastThreshold(in_data, "data", notes=notes, dead_time=dead_time)
    estimate = solution.threshold if solution else None
    if stated is not None:
        positive, negative = (stated * r for r in estimate.relative) if estimate else (None, None)
        return ContrastThreshold(stated, "settings", positive, negative, notes=notes, dead_time=dead_time)
    found = estimate or ContrastThreshold(DEFAULT, "default", notes=notes)
    return replace(found, dead_time=dead_time)


def contrast_from_images(
    sequence: EventDepthSequence,
    start: float,  # seconds
    end: float,
    dead_time: float = 0.0,  # seconds
) -> ContrastThreshold | None:
    """Return the threshold estimated from images in [start, end]; None if they do not suffice."""
    solution = _from_images(sequence, start, end, MAX_PAIRS, dead_time)
    return solution.threshold if solution else None


@dataclass(frozen=True)
class _Solution:
    """What images say, whether or not it can be a threshold."""

    estimate: np.ndarray  # [2] C+ and C-
    without_one: np.ndarray  # [P, 2] the same without one pair of images

    @property
    def deviations(self) -> np.ndarray:  # [2]
        """Standard deviations of C+ and C- among the pairs of images (jackknife)."""
        return np.sqrt((len(self.without_one) - 1) * self.without_one.var(0))

    @property
    def threshold(self) -> ContrastThreshold | None:
        """The threshold, None where the estimate is none: not finite, or not positive."""
        if not (np.isfinite(self.without_one).all() and (self.estimate > 0).all()):
            return None
        n, means = len(self.without_one), self.without_one.mean(1)
        deviation = float(np.sqrt((n - 1) * means.var()))
        positive, negative = (float(c) for c in self.estimate)
        value, of_each = 0.5 * (positive + negative), (float(self.deviations[0]), float(self.deviations[1]))
        return ContrastThreshold(value, "images", positive, negative, deviation, deviations=of_each)

    @property
    def notes(self) -> tuple[str, ...]:
        """Whether polarity is inverted: both thresholds are surely negative."""
        if not np.isfinite(self.without_one).all():
            return ()
        if not (self.estimate < -SURELY_INVERTED * np.maximum(self.deviations, LEAST_DEVIATION)).all():
            return ()
        return (
            "polarity looks inverted: images become darker where events say brighter "
            f"(C = {self.estimate.mean():.2f}); swap the polarity of the events",
        )


def _from_images(
    sequence: EventDepthSequence, start: float, end: float, max_pairs: int, dead_time: float
) -> _Solution | None:
    """Return what images inside [start, end] say, None where there are too few of them or of events."""
    stamps = sequence.image_timestamps
    inside = np.nonzero((stamps >= start) & (stamps <= end))[0]
    products = []
    for gap in GAPS:
        pairs = [(a, b) for a, b in zip(inside, inside[gap:]) if stamps[b] - stamps[a] <= LONGEST_PAIR]
        step = max(1, len(pairs) // max_pairs)
        compared = (_products(sequence, int(a), int(b), dead_time) for a, b in pairs[::step][:max_pairs])
        products += [p for p in compared if p is not None]
    if len(products) < 2 or np.sum([p.events for p in products], 0).min() < MIN_EVENTS:
        return None
    M, v = (
        np.array([p.instruments_events for p in products]),
        np.array([p.instruments_change for p in products]),
    )
    estimate = _solved(M.sum(0), v.sum(0))
    without_one = np.array([_solved(M.sum(0) - m, v.sum(0) - w) for m, w in zip(M, v)])
    return _Solution(estimate, without_one)


@dataclass(frozen=True)
class _Products:
    """Sums over the pixels of a pair of images."""

    instruments_events: np.ndarray  # [2, 2] Z^T X
    instruments_change: np.ndarray  # [2] Z^T y
    events: np.ndarray  # [2] positive and negative ones


def _products(sequence: EventDepthSequence, first: int, second: int, dead_time: float) -> _Products | None:
    """Return the sums of a pair of images, None where one of them cannot be read."""
    before, after = sequence.image_or_none(first), sequence.image_or_none(second)
    if before is None or after is None:
        return None
    start, end = (float(sequence.image_timestamps[k]) for k in (first, second))
    regressors = _regressors(sequence.events(start - HISTORY, end), start, before.shape, dead_time)
    square = (cv2.boxFilter(r, -1, (RING, RING), normalize=False) for r in regressors)
    around = [s - cv2.boxFilter(r, -1, (3, 3), normalize=False) for s, r in zip(square, regressors)]
    usable = np.ones(before.shape, bool)
    for image in (before, after):
        usable &= (image > DARKEST) & (image < BRIGHTEST)
    change = np.log((after[usable] + LOG_EPSILON) / (before[usable] + LOG_EPSILON)).astype(np.float64)
    X, Z = (
        np.stack([image[usable] for image in images]).astype(np.float64) for images in (regressors, around)
    )
    return _Products(Z @ X.T, Z @ change, np.abs(X).sum(1))


def _regressors(
    events: Events, start: float, shape: tuple[int, int], dead_time: float
) -> np.ndarray:  # [2, H, W] float32
    """Return p and -n from the start on, each corrected by the mean distance beyond the last event."""
    before = EventCounts(events.between(-np.inf, start), shape).last
    counts = EventCounts(events.between(start, np.inf), shape)
    last = np.where(counts.last == 0, before, counts.last)
    bias = np.float32(AVERAGE_BIAS)
    p, n = (
        counts.numbers[..., k].astype(np.float32) + bias * (sign * last > 0) - bias * (sign * before > 0)
        for k, sign in ((1, 1), (0, -1))
    )
    if dead_time > 0:
        missed_change = MissedChange(shape, dead_time)
        missed_change.of(events.between(-np.inf, start))
        missed = missed_change.of(events.between(start, np.inf))
        p, n = p + missed[..., 1], n + missed[..., 0]
    return np.stack([p, -n])


def _solved(M: np.ndarray, v: np.ndarray) -> np.ndarray:  # [2, 2], [2] -> [2]
    """Return M^-1 v; nan if the pixels do not determine C+ and C- separately."""
    if np.linalg.cond(M) > 1e6:
        return np.full(2, np.nan)
    return np.asarray(np.linalg.solve(M, v))
