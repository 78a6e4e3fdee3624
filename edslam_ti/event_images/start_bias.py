"""Where pixels stand between two events when a recording begins.

A pixel that has leaked for long stands anywhere between its last event and the next brighter one: brightness
is beyond its reference by about half of C+. Counted from the start, its first brighter event comes too early,
and the whole scene seems to become brighter while pixels fire for the first time. A scene does not do that,
so the sum of polarities beside the number of pixels that have fired shows it.
"""

import numpy as np

from edslam_ti.datasets.base import EventDepthSequence

FIRST = 0.1  # seconds, in which most pixels of a moving camera fire for the first time
BINS = 5
SURE = 0.25  # thresholds a pixel; a camera that turns towards the light gives less in so short a time
LEAKED = 0.45  # thresholds; a little less than half, because those beyond by more have fired
HOT = 5  # times the usual number of events; pixels with more are left out
LEAST_PIXELS = 200  # that have fired


def start_bias(
    sequence: EventDepthSequence,
    start: float,  # seconds
    relative: tuple[float, float],  # C+ and C- in (mean) thresholds
) -> float:
    """Return by how many thresholds brightness is beyond pixels' references at the start, on average."""
    events, (height, width) = sequence.events(start, start + FIRST), sequence.camera.shape
    pixel = events.y.astype(np.int64) * width + events.x
    number = np.bincount(pixel, minlength=height * width)
    fired = number > 0
    if fired.sum() < LEAST_PIXELS:
        return 0.0
    kept = (number <= HOT * max(float(np.median(number[fired])), 1.0))[pixel]
    is_first = np.zeros(len(pixel), bool)
    is_first[np.unique(pixel, return_index=True)[1]] = True
    at = np.minimum((BINS * (events.t - start) / FIRST).astype(int), BINS - 1)
    worth = np.where(events.polarity > 0, relative[0], -relative[1])
    change = np.cumsum(np.bincount(at[kept], worth[kept], BINS))
    number_fired = np.cumsum(np.bincount(at[kept & is_first], minlength=BINS))
    measured = (change * number_fired).sum() / (number_fired**2).sum()
    return LEAKED if measured > SURE else 0.0
