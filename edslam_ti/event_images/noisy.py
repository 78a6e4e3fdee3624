"""Noisy pixels, which fire without a change of brightness, and their replacement by their neighbours."""

import cv2
import numpy as np

from edslam_ti.frame import EventCounts

NOISY = 10.0  # a pixel is noisy if it has more than this many times the median events of its neighbours
NOISY_EVENTS = 100  # a pixel with fewer events is not called noisy
AROUND = 5  # px, width of the neighbourhood


class NoisyPixels:
    """Finds pixels that have had many times the events of their neighbours since the first frame.

    A pixel at 5 kHz is found in the first frame of 50 ms, one at 200 Hz after half a second.
    """

    def __init__(self, shape: tuple[int, int]) -> None:  # (H, W)
        self.mask = np.zeros(shape, bool)  # [H, W]
        self._numbers = np.zeros(shape, np.float32)  # of events

    def add(self, counts: EventCounts) -> None:
        """Add a frame's events."""
        self._numbers += counts.numbers.sum(-1)
        # The minimum of the neighbours is far faster than their median, and not larger: a cheap first test.
        least = cv2.erode(self._numbers, np.ones((AROUND, AROUND), np.uint8))
        if not (self._numbers > np.maximum(NOISY * least, NOISY_EVENTS)).any():
            self.mask = np.zeros_like(self.mask)
            return
        around = cv2.medianBlur(self._numbers, AROUND)
        self.mask = self._numbers > np.maximum(NOISY * around, NOISY_EVENTS)

    def replaced(self, image: np.ndarray) -> np.ndarray:  # [H, W] float32
        """Return the image with noisy pixels replaced by the median of their neighbours."""
        if not self.mask.any():
            return image
        result = image.copy()
        result[self.mask] = cv2.medianBlur(image, AROUND)[self.mask]
        return result

    def num_other_events(self, counts: EventCounts) -> int:
        """Return the number of a frame's events that are not of noisy pixels."""
        return int(counts.numbers.sum()) - int(counts.numbers[self.mask].sum())
