"""The contrast threshold C of Eq. 11, estimated from grey images where the data states none.

Events alone do not fix it: multiply all log brightness and C by one factor, and the same events come out
(maps, renders and poses are then right up to that factor, which a fit of slope and offset in log brightness
takes away). A few grey images do: between two of them, a pixel whose brightness only rises by y fires

    n = y / C + b,     b between -1 and 0, for what was left over of the last event

events, so that C is one over the slope of n against y (not the inverse, whose slope the noise of n biases).
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from edslam_ti.datasets.base import EventDepthSequence

DEFAULT = 0.1  # Sec. IV-A: 0.1 synthetic, 0.2 real
MAX_PAIRS = 12  # of consecutive images
LONGEST_PAIR = 0.2  # seconds between the two
DARKEST, BRIGHTEST = 0.1, 0.98  # grey values that are neither lost in 8 bits nor clipped
MIN_CHANGE = 0.25  # log brightness
MIN_PIXELS = 200  # of either polarity
OUTLIER = 3.0  # standard deviations
LOG_EPSILON = 0.004


@dataclass(frozen=True)
class ContrastThreshold:
    """C and where it comes from; standard deviations are of the fit."""

    value: float
    source: str  # "settings", "data", "images" or "default"
    positive: float | None = None
    negative: float | None = None
    deviation: float | None = None  # of `value`; systematic errors are larger, 2 % in simulated rooms

    @property
    def relative(self) -> tuple[float, float]:
        """Return the positive and the negative threshold divided by `value`; 1 where they are not known."""
        if self.positive is None or self.negative is None:
            return 1.0, 1.0
        return self.positive / self.value, self.negative / self.value


def contrast_threshold(
    stated: float | None,  # by the settings
    sequence: EventDepthSequence,
    start: float,  # seconds
    end: float,
) -> ContrastThreshold:
    """Return the threshold that the settings or the data state, else an estimate, else the default."""
    if stated is not None:
        return ContrastThreshold(stated, "settings")
    if sequence.contrast_threshold is not None:
        return ContrastThreshold(sequence.contrast_threshold, "data")
    return contrast_from_images(sequence, start, end) or ContrastThreshold(DEFAULT, "default")


def contrast_from_images(
    sequence: EventDepthSequence,
    start: float,  # seconds
    end: float,
) -> ContrastThreshold | None:
    """Return the threshold by brightness changes between images inside [start, end], None without enough."""
    stamps = sequence.image_timestamps
    inside = np.nonzero((stamps >= start) & (stamps <= end))[0]
    pairs = [(a, b) for a, b in pairwise(inside) if stamps[b] - stamps[a] <= LONGEST_PAIR]
    step = max(1, len(pairs) // MAX_PAIRS)
    changes, counts = [np.empty(0)], [np.empty(0)]
    for a, b in pairs[::step][:MAX_PAIRS]:
        before, after = sequence.image(int(a)), sequence.image(int(b))
        events = sequence.events(float(stamps[a]), float(stamps[b]))
        count, total = np.zeros(before.shape), np.zeros(before.shape)
        np.add.at(count, (events.y, events.x), events.polarity.astype(float))
        np.add.at(total, (events.y, events.x), 1.0)
        usable = np.abs(count) == total  # the change had one direction
        for image in (before, after):
            usable &= (image > DARKEST) & (image < BRIGHTEST)
        changes.append(np.log((after[usable] + LOG_EPSILON) / (before[usable] + LOG_EPSILON)))
        counts.append(count[usable])
    change, count = np.concatenate(changes), np.concatenate(counts)
    fits = [_fit(sign * change, sign * count) for sign in (1, -1)]
    if any(fit is None for fit in fits):
        return None
    (positive, d_positive), (negative, d_negative) = (fit for fit in fits if fit is not None)
    mean, deviation = 0.5 * (positive + negative), 0.5 * float(np.hypot(d_positive, d_negative))
    return ContrastThreshold(mean, "images", positive, negative, deviation)


def _fit(change: np.ndarray, count: np.ndarray) -> tuple[float, float] | None:
    """Return C and its standard deviation from changes of one sign, None with too few pixels."""
    kept = change > MIN_CHANGE
    y, n = change[kept], count[kept]
    for _ in range(3):
        if len(y) < MIN_PIXELS:
            return None
        slope, offset = np.polyfit(y, n, 1)
        residual = n - slope * y - offset
        deviation = residual.std()
        kept = np.abs(residual) <= OUTLIER * deviation
        y, n = y[kept], n[kept]
    if slope <= 0:
        return None
    slope_deviation = deviation / (y.std() * np.sqrt(len(y)))
    return float(1 / slope), float(slope_deviation / slope**2)
