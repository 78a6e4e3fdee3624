"""Pixels that fire by themselves, and images in which their neighbours stand in for them."""

import cv2
import numpy as np

from edslam_ti.frame import EventCounts

NOISY = 10.0  # times the median of a pixel's neighbours: it fires by itself
NOISY_EVENTS = 100  # a pixel with fewer is not called noisy
AROUND = 5  # px, width of the square whose median is compared


class NoisyPixels:
    """Finds pixels that have had many times the events of those around them, since the first frame.

    A pixel at 5 kHz is found in the first frame of 50 ms, one at 200 Hz after half a second.
    """

    def __init__(self, shape: tuple[int, int]) -> None:  # (H, W)
        self.mask = np.zeros(shape, bool)  # [H, W]
        self._numbers = np.zeros(shape, np.float32)  # of events

    def add(self, counts: EventCounts) -> None:
        """Add the events of a frame that follows those added before."""
        self._numbers += counts.numbers.sum(-1)
        # The least of the neighbours is found far faster than their median, and is not larger.
        least = cv2.erode(self._numbers, np.ones((AROUND, AROUND), np.uint8))
        if not (self._numbers > np.maximum(NOISY * least, NOISY_EVENTS)).any():
            self.mask = np.zeros_like(self.mask)
            return
        around = cv2.medianBlur(self._numbers, AROUND)
        self.mask = self._numbers > np.maximum(NOISY * around, NOISY_EVENTS)

    def replaced(self, image: np.ndarray) -> np.ndarray:  # [H, W] float32
        """Return an image with the median of their neighbours at noisy pixels; unchanged without any."""
        if not self.mask.any():
            return image
        result = image.copy()
        result[self.mask] = cv2.medianBlur(image, AROUND)[self.mask]
        return result

    def num_other_events(self, counts: EventCounts) -> int:
        """Return the number of a frame's events that are not of noisy pixels."""
        return int(counts.numbers.sum()) - int(counts.numbers[self.mask].sum())
