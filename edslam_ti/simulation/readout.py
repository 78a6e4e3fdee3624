"""The read-out of an event sensor: rows that are scanned in turn, and a limited rate.

A scanning sensor reads row r of H at k P + (r + 1) P / H, for whole k and the scan's period P. An event gets
the time at which its row is read next; a pixel has at most one event in a scan. Where pixels ask to be read
(P = 0), times are their own.

Behind it, one event is passed on after the other, `rate` a second at most: an event's time stamp is

    s_i = max(t_i, s_(i-1)) + 1 / rate.

What would wait for longer than QUEUE is lost: buffers are full.
"""

import itertools

import numpy as np

from edslam_ti.kernels.event_simulation import EventArrays

QUEUE = 10_000_000  # nanoseconds of events that buffers hold
BIN = 100_000  # nanoseconds in which losses are counted


class Readout:
    """Passes events on with the time stamps that the sensor gives them."""

    def __init__(self, height: int, period: float, rate: float) -> None:
        """`period` in seconds, 0: pixels are read when they ask; `rate` in events a second, 0: any number."""
        self._height = height
        self._period, self._rate = round(period * 1e9), rate
        self._waiting = _empty()
        self._last_scan = np.empty(0, np.int64)  # scan and pixel of events of scans that are not over
        self._free_at = 0.0  # ns, when all that has been accepted has been passed on

    def passed_on(self, events: EventArrays, until: int) -> EventArrays:
        """Return the events that are read until a time (ns), in order of their stamps."""
        if self._period == 0 and self._rate == 0:
            return events
        if self._period > 0:
            events = self._scanned(events)
        everything = _sorted(_joined(self._waiting, events))
        if self._rate > 0:
            ready = _chosen(everything, everything.t <= until)
            self._waiting = _chosen(everything, everything.t > until)
            return self._limited(ready)
        self._waiting = _chosen(everything, everything.t > until)
        return _chosen(everything, everything.t <= until)

    def _scanned(self, events: EventArrays) -> EventArrays:
        """Return the events with the times at which their rows are read, one of a pixel in each scan."""
        offset = (events.y.astype(np.int64) + 1) * self._period // self._height
        scan = -(-(events.t - offset) // self._period)
        key = (scan << 32) | (events.y.astype(np.int64) << 16) | events.x
        _, first = np.unique(key, return_index=True)
        is_first = np.zeros(len(key), bool)
        is_first[first] = True
        is_first &= ~np.isin(key, self._last_scan)
        if len(scan):
            self._last_scan = key[scan >= scan.max() - 1]
        stamped = EventArrays(events.x, events.y, scan * self._period + offset, events.polarity)
        return _chosen(stamped, is_first)

    def _limited(self, events: EventArrays) -> EventArrays:
        """Return the events with the times at which they are passed on; those that find no room are lost."""
        if len(events.t) == 0:
            return events
        kept = np.ones(len(events.t), bool)
        bins = (events.t - events.t[0]) // BIN
        starts = np.searchsorted(bins, np.arange(int(bins[-1]) + 2))
        free_at, each = self._free_at, 1e9 / self._rate
        for k, (a, b) in enumerate(itertools.pairwise(starts)):
            if a == b:
                continue
            begin = float(events.t[0] + k * BIN)
            room = int(max(0.0, (begin + BIN + QUEUE - max(free_at, begin)) / each))
            kept[a + room : b] = False
            free_at = max(free_at, begin) + min(b - a, room) * each
        events = _chosen(events, kept)
        done = np.arange(len(events.t)) * each  # time spent on those before
        start = np.maximum.accumulate(np.maximum(events.t - done, self._free_at))
        stamps = start + done + each
        self._free_at = float(stamps[-1])
        return EventArrays(events.x, events.y, np.rint(stamps).astype(np.int64), events.polarity)


def _empty() -> EventArrays:
    return EventArrays(
        np.empty(0, np.int16), np.empty(0, np.int16), np.empty(0, np.int64), np.empty(0, np.int8)
    )


def _joined(a: EventArrays, b: EventArrays) -> EventArrays:
    names = ("x", "y", "t", "polarity")
    return EventArrays(*(np.concatenate([getattr(a, n), getattr(b, n)]) for n in names))


def _chosen(events: EventArrays, which: np.ndarray) -> EventArrays:
    return EventArrays(events.x[which], events.y[which], events.t[which], events.polarity[which])


def _sorted(events: EventArrays) -> EventArrays:
    return _chosen(events, np.argsort(events.t, kind="stable"))
