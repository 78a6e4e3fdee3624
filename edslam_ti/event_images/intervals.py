"""How long ago a pixel's last event was, and what an event is worth after a dead time.

Brightness that changes steadily crosses a threshold C within d - D after the pixel wakes from a dead time D.
During an interval of d it has changed by C d / (d - D): that is what an event is worth whose predecessor has
the same polarity. After the other polarity it is worth C: brightness may have turned back at any time.
"""

import numpy as np

from edslam_ti.events import Events

MOST_WORTH = 10.0  # thresholds that one event can stand for


def event_worth(
    interval: np.ndarray,  # [N] s since the last event of the pixel; inf: the first
    is_same: np.ndarray,  # [N] bool, whether that had the same polarity
    dead_time: float | None,  # s
) -> np.ndarray:  # [N] float64
    """Return how many thresholds each event stands for: d / (d - D) where brightness went on as before."""
    if not dead_time:
        return np.ones(len(interval))
    lit = np.maximum(1 - dead_time / np.maximum(interval, 1e-9), 1 / MOST_WORTH)
    return np.where(is_same, 1 / lit, 1.0)


def intervals(events: Events, width: int) -> tuple[np.ndarray, np.ndarray]:  # [N] s, [N] bool
    """Return the time since the last event of each event's pixel, and whether that had the same polarity."""
    pixel = events.y.astype(np.int64) * width + events.x
    order = np.argsort(pixel, kind="stable")
    same_pixel = np.diff(pixel[order]) == 0
    times, polarity = events.t[order], events.polarity[order]
    since, is_same = np.full(len(events), np.inf), np.zeros(len(events), bool)
    later = order[1:][same_pixel]
    since[later] = np.diff(times)[same_pixel]
    is_same[later] = (polarity[1:] == polarity[:-1])[same_pixel]
    return since, is_same
