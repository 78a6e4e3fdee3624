"""Change of every pixel's log brightness since a start time, measured by events (Eq. 11).

Events are counted once per frame (`Frame.event_counts`). The tracker reads the change up to now
(`BrightnessChange`), the mapper the change up to each of many frames (`ChangeArchive`). They start at
different times and treat the last event differently, so each keeps a sum of its own.

An event says that brightness has crossed a level. Now it may be up to one threshold C beyond that level, in
the event's direction unless it has turned since. The constants below are the mean distance beyond the level;
it depends on what is known of the pixel.
"""

import numpy as np

from edslam_ti.frame import EventCounts

# In thresholds, in the direction of the last event, for a pixel that is changing and whose next event is not
# known: the distance is uniform from 0 to 1. Without this term a moving edge of contrast g per pixel lags by
# C / 2g pixels, which biases alignment.
NEWEST_BIAS = 0.5
# The same once the next event is known, too: this much in the direction of the last event plus this much in
# that of the next one. The two terms add if the pixel continues and cancel if it turns. Measured on simulated
# rooms (less than 0.25, because many pixels rest in between); without it contrast is too small.
BETWEEN_BIAS = 0.2
# The same as a mean over all pixels of an image, changing or not, for the regression in contrast.py.
# Measured: without it a threshold of 0.35 is estimated 3 to 6 % too large; with it as a second unknown, 10 %
# too small.
AVERAGE_BIAS = 0.25


class BrightnessChange:
    """Log-brightness change of every pixel from the start up to the newest event (Eq. 11)."""

    def __init__(self, shape: tuple[int, int], positive: float, negative: float) -> None:
        """`positive` and `negative` are the sensor's thresholds C+ and C-, in log brightness."""
        self._thresholds = np.float32(positive), np.float32(negative)
        self._numbers = np.zeros((*shape, 2), np.int32)  # negative and positive events
        self._last = np.zeros(shape, np.int8)  # polarity of the last event
        self._missed: np.ndarray | None = None  # [H, W, 2] float32, in dead time

    def add(self, counts: EventCounts) -> None:
        """Add events; they must be later than all added before."""
        self._numbers += counts.numbers
        if counts.missed is not None:
            self._missed = counts.missed if self._missed is None else self._missed + counts.missed
        # Silent pixels keep their last polarity; a product and a sum are far faster than a masked copy.
        self._last *= counts.last == 0
        self._last += counts.last

    def log_brightness(self) -> np.ndarray:  # [H, W] float32
        """Return the change since the start."""
        positive, negative = self._thresholds
        beyond = np.float32(NEWEST_BIAS)
        fell = self._numbers[..., 0].astype(np.float32) + beyond * (self._last < 0)
        rose = self._numbers[..., 1].astype(np.float32) + beyond * (self._last > 0)
        if self._missed is not None:
            fell, rose = fell + self._missed[..., 0], rose + self._missed[..., 1]
        return positive * rose - negative * fell

    def reset(self) -> None:
        """Start again with no change."""
        self._numbers[:], self._last[:], self._missed = 0, 0, None


class ChangeArchive:
    """The change of every pixel from the start up to each of several frames (Eq. 11).

    When a pixel's next event arrives, the images of earlier frames are corrected.
    """

    STEPS = 50  # units of the stored images in one threshold

    def __init__(
        self,
        shape: tuple[int, int],
        positive: float = 1.0,  # change per event of each polarity, in (mean) thresholds
        negative: float = 1.0,
        start_bias: float = 0.0,  # thresholds beyond the reference at the start, on average
        keeps_activity: bool = False,  # for `activity`
    ) -> None:
        # Units per event; not rounded, because rounding errors would accumulate
        self._positive, self._negative = self.STEPS * positive, self.STEPS * negative
        self._level = np.zeros(shape, np.float32)  # units, sum of events since the start
        # Pixels that have not fired yet stand where they stood at the start
        self._beyond = np.full(
            shape, round(self.STEPS * start_bias), np.int16
        )  # units beyond the last event's level
        self._last_frame = np.zeros(shape, np.int32)  # frame of the pixel's last event
        self._images: dict[int, np.ndarray] = {}  # [H, W] int16 by frame
        self._keeps_activity = keeps_activity
        self._total = np.zeros(shape, np.float32)  # units, sum of the events' sizes since the start
        self._totals: dict[int, np.ndarray] = {}  # [H, W] uint16 by frame

    def __len__(self) -> int:
        return len(self._images)

    @property
    def frames(self) -> list[int]:
        """Frames whose images are kept, in order of time."""
        return list(self._images)

    def add(self, counts: EventCounts, index: int, is_kept: bool) -> None:
        """Add the events up to frame `index`; `is_kept`: keep the change up to it."""
        first, last = counts.first.ravel(), counts.last.ravel()
        fired = np.flatnonzero(first)
        self._add_next_event(fired, self._bias(first[fired]))
        self._level += np.float32(self._positive) * counts.numbers[..., 1]
        self._level -= np.float32(self._negative) * counts.numbers[..., 0]
        if counts.missed is not None:
            self._level += np.float32(self._positive) * counts.missed[..., 1]
            self._level -= np.float32(self._negative) * counts.missed[..., 0]
        if self._keeps_activity:
            self._add_activity(counts)
        self._beyond.ravel()[fired] = self._bias(last[fired])
        self._last_frame.ravel()[fired] = index
        if is_kept:
            self._images[index] = np.rint(self._level).astype(np.int16) + self._beyond
            if self._keeps_activity:
                self._totals[index] = np.minimum(self._total, 65535).astype(np.uint16)

    def _add_activity(self, counts: EventCounts) -> None:
        for polarity, worth in ((1, self._positive), (0, self._negative)):
            self._total += np.float32(worth) * counts.numbers[..., polarity]
            if counts.missed is not None:
                self._total += np.float32(worth) * counts.missed[..., polarity]

    def _bias(self, polarity: np.ndarray) -> np.ndarray:  # [P] -> [P] int16
        """Return how many units brightness is beyond an event's level."""
        worth = np.where(polarity > 0, self._positive, -self._negative)
        return np.rint(BETWEEN_BIAS * worth).astype(np.int16)

    def _add_next_event(self, pixels: np.ndarray, bias: np.ndarray) -> None:
        """Add the bias [P] of pixels' next event to the kept images since their last event (mostly few)."""
        last_frame = self._last_frame.ravel()[pixels]
        for frame in reversed(self._images):
            is_waiting = last_frame <= frame
            pixels, bias, last_frame = pixels[is_waiting], bias[is_waiting], last_frame[is_waiting]
            if len(pixels) == 0:
                return
            self._images[frame].ravel()[pixels] += bias

    def change(self, index: int) -> np.ndarray:  # [H, W] float32
        """Return the change from the start to a kept frame, in contrast thresholds."""
        return self._images[index].astype(np.float32) / self.STEPS

    def activity(self, index: int) -> np.ndarray:  # [H, W] float32
        """Return the sum of all changes from the start to a kept frame, up and down, in thresholds."""
        return self._totals[index].astype(np.float32) / self.STEPS

    def drop(self, index: int) -> None:
        """Remove a frame's image."""
        del self._images[index]
        self._totals.pop(index, None)

    def reset(self) -> tuple[np.ndarray, np.ndarray]:  # [H, W] float32 each
        """Make now the start; return change and activity since the old one. Kept images stay unchanged."""
        change = (self._level + self._beyond).astype(np.float32) / self.STEPS
        activity = self._total / self.STEPS
        self._level[:], self._total[:] = 0, 0
        return change, activity
