"""The dead time that lets events explain best how brightness changes between two images.

For each of several dead times, events count as intervals.py says; C+ and C- come from least squares.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from edslam_ti.datasets.base import EventDepthSequence
from edslam_ti.event_images.contrast import BRIGHTEST, DARKEST, LOG_EPSILON, LONGEST_PAIR
from edslam_ti.event_images.intervals import event_worth, intervals

MAX_PAIRS = 6
HISTORY = 0.1  # s before a pair that are searched for the last event of a pixel
SHARES = np.linspace(0, 1, 9)  # of the shortest interval: the dead times that are tried
SURE = 3.0  # standard deviations of the gain in rms over none at all
SHARP = 0.03  # gain beyond which the best dead time is believed
MIN_PIXELS = 200


@dataclass(frozen=True)
class FoundDeadTime:
    """What images say."""

    value: float  # s; 0: there is none
    is_sure: bool  # else they neither show one nor exclude it


def dead_time_from_images(
    sequence: EventDepthSequence,
    start: float,  # seconds
    end: float,
    shortest: float,  # s, interval between events of a pixel, which no dead time can exceed
) -> FoundDeadTime | None:
    """Return the dead time that images speak for; None: too few images."""
    stamps = sequence.image_timestamps
    inside = np.nonzero((stamps >= start) & (stamps <= end))[0]
    pairs = [(int(a), int(b)) for a, b in itertools.pairwise(inside) if stamps[b] - stamps[a] <= LONGEST_PAIR]
    step = max(1, len(pairs) // MAX_PAIRS)
    sums = [_sums(sequence, *pair, SHARES * shortest) for pair in pairs[::step][:MAX_PAIRS]]
    known = [s for s in sums if s is not None]
    if len(known) < 3:
        return None
    M, v, square = (np.array([s[k] for s in known]) for k in range(3))  # [P, D, 2, 2], [P, D, 2], [P]
    if np.linalg.cond(M.sum(0)).max() > 1e6:
        return None
    misfit = _misfits(M.sum(0), v.sum(0), square.sum())
    best = int(misfit.argmin())
    gain = 1 - misfit / misfit[0]
    gains = []
    for k in range(len(known)):  # without one pair
        kept = np.arange(len(known)) != k
        part = _misfits(M[kept].sum(0), v[kept].sum(0), square[kept].sum())
        gains.append(1 - part[best] / part[0])
    deviation = float(np.sqrt((len(known) - 1) * np.var(gains)))
    if best == 0 or gain[best] < max(SHARP, SURE * deviation):
        return FoundDeadTime(0.0, best == 0)
    share = SHARES[best]
    if best < len(SHARES) - 1:  # the lowest point of the parabola through three
        left, middle, right = misfit[best - 1 : best + 2]
        share += 0.5 * (left - right) / (left - 2 * middle + right) * SHARES[1]
    return FoundDeadTime(float(share * shortest), True)


def _misfits(M: np.ndarray, v: np.ndarray, square: float) -> np.ndarray:  # [D, 2, 2], [D, 2] -> [D]
    """Return the root of the sum of squares that least squares leave for each dead time."""
    solved = np.linalg.solve(M, v[..., None])[..., 0]
    return np.sqrt(np.maximum(square - (solved * v).sum(-1), 0))


def _sums(
    sequence: EventDepthSequence, first: int, second: int, dead_times: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Return X^T X [D, 2, 2], X^T y [D, 2] and y^T y of a pair of images; None: they cannot be used."""
    before, after = sequence.image_or_none(first), sequence.image_or_none(second)
    if before is None or after is None:
        return None
    height, width = before.shape
    start, end = (float(sequence.image_timestamps[k]) for k in (first, second))
    events = sequence.events(start - HISTORY, end)
    since, is_same = intervals(events, width)
    usable = np.ones(before.shape, bool)
    for image in (before, after):
        usable &= (image > DARKEST) & (image < BRIGHTEST)
    if usable.sum() < MIN_PIXELS:
        return None
    change = np.log((after[usable] + LOG_EPSILON) / (before[usable] + LOG_EPSILON)).astype(np.float64)
    pixel = events.y.astype(np.int64) * width + events.x
    M, v = [], []
    for dead_time in dead_times:
        worth = event_worth(since, is_same, float(dead_time))
        columns = []
        for sign in (1, -1):
            chosen = (events.t >= start) & (events.polarity == sign)
            total = np.bincount(pixel[chosen], sign * worth[chosen], height * width)
            columns.append(total.reshape(height, width)[usable])
        X = np.stack(columns, -1)
        M.append(X.T @ X)
        v.append(X.T @ change)
    return np.array(M), np.array(v), float(change @ change)
