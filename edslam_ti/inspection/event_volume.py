"""The events of a part of a recording, counted per pixel and in bins of time, at a reduced size."""

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets import EventDepthSequence
from edslam_ti.events import Events

BIN = 0.005  # s
WIDTH = 160  # px; larger images are reduced to about this
READ_AT_ONCE = 0.05  # s
LONGEST = 4.0  # s that are looked at closely
PROBES, PROBE = 12, 0.02  # stretches that are compared, and s in each of three places of one


class EventVolume:
    """Counts of events by pixel and time; `change` and `number` sum them over any interval."""

    def __init__(self, sequence: EventDepthSequence, start: float, end: float) -> None:
        self.start, self.end = start, end
        self.factor = max(1, int(np.ceil(sequence.camera.width / WIDTH - 0.25)))
        self.camera: Camera = sequence.camera.downscaled(self.factor)
        height, width = self.camera.shape
        bins = max(1, int(np.ceil((end - start) / BIN - 1e-6)))
        counts = np.zeros((2, bins + 1, height, width), np.float32)  # negative and positive; bin 0 stays 0
        flat = counts.reshape(2, -1)
        for t in np.arange(start, end, READ_AT_ONCE):
            self._count(sequence.events(float(t), min(float(t) + READ_AT_ONCE, end)), bins, flat)
        self._change = np.cumsum(counts[1] - counts[0], 0)  # [B + 1, H, W] up to the start of a bin
        self._number = np.cumsum(counts[1] + counts[0], 0)

    def _count(self, events: Events, bins: int, flat: np.ndarray) -> None:
        height, width = self.camera.shape
        x, y = events.x // self.factor, events.y // self.factor
        k = np.clip(((events.t - self.start) / BIN).astype(np.int64), 0, bins - 1) + 1
        place = (k * height + y) * width + x
        inside = (x < width) & (y < height)
        for row, sign in ((flat[0], -1), (flat[1], 1)):
            places, number = np.unique(place[inside & (events.polarity == sign)], return_counts=True)
            row[places] += number

    def change(self, start: float, end: float) -> np.ndarray:  # [H, W] float32
        """Return positive minus negative events in an interval (s), interpolated within bins."""
        return self._at(self._change, end) - self._at(self._change, start)

    def number(self, start: float, end: float) -> np.ndarray:  # [H, W] float32
        """Return the number of events in an interval (s), interpolated within bins."""
        return self._at(self._number, end) - self._at(self._number, start)

    def around(self, time: float, share: float) -> np.ndarray:  # [H, W] float32
        """Return the number of events around a time, in an interval that holds `share` events per pixel."""
        half = BIN
        while half < 20 * BIN:
            if (number := self.number(time - half, time + half)).sum() >= share * number.size:
                break
            half *= 1.5
        return self.number(time - half, time + half)

    def _at(self, sums: np.ndarray, time: float) -> np.ndarray:
        k = float(np.clip((time - self.start) / BIN, 0, len(sums) - 1))
        i = min(int(k), len(sums) - 2)
        return np.asarray(sums[i] + np.float32(k - i) * (sums[i + 1] - sums[i]))


def liveliest_part(sequence: EventDepthSequence) -> tuple[float, float]:
    """Return start and end (s) of the part of at most `LONGEST` seconds with the most events."""
    first, last = sequence.time_range
    if sequence.has_events and len(sequence.depth_timestamps) > 1:  # where there is depth, too
        first = max(first, float(sequence.depth_timestamps[0]) - READ_AT_ONCE)
        last = min(last, float(sequence.depth_timestamps[-1]) + READ_AT_ONCE)
    if last <= first:
        return sequence.time_range
    if last - first <= LONGEST or not sequence.has_events:
        return first, min(last, first + LONGEST)
    starts = np.linspace(first, last - LONGEST, PROBES)
    numbers = [
        sum(len(sequence.events(s + q * LONGEST, s + q * LONGEST + PROBE)) for q in (0.1, 0.5, 0.9))
        for s in starts
    ]
    best = float(starts[int(np.argmax(numbers))])
    return best, best + LONGEST
