"""Each pixel's own thresholds, found by comparing its events with what a map of many pixels shows.

The thresholds of a real sensor differ from pixel to pixel, by 10 to 20 %, for both polarities separately. So
a pixel's change E (Eq. 11) is too large by a share of it, and drifts with the sum A of all changes, up and
down:

    true change = E + a E + b A        a = (d+ + d-) / 2,  b = (d+ - d-) / 2,  d: relative errors of C+, C-

A point of a surface is seen by many pixels one after the other, so that a map has their mean. With the log
brightness R_k that the map shows at a pixel in frame k, and the unknown s of the start image,

    R_k - (start + E_k) = s + a E_k + b A_k        for all frames k of a window

are linear equations of each pixel; a and b are the same in all windows.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

ERROR = 0.1  # log brightness, standard deviation of what the map shows
SPREAD = 0.1  # of a and b, among pixels
LARGEST_DIFFERENCE = 0.5  # log brightness; larger ones are occlusions and the like, and count as this one
NEIGHBOURS = 3.0  # px, standard deviation
LEAST_FRAMES = 3  # of a window in which a pixel is compared
LARGEST = 0.6  # of a and b: a threshold of less than a tenth of the usual one, or twice as large


class Compared(NamedTuple):
    """A frame's measurements beside what the map shows."""

    window: int  # frames of one start image
    difference: np.ndarray  # [H, W] log brightness of the map minus measured
    change: np.ndarray  # [H, W] log brightness since the start, E
    activity: np.ndarray  # [H, W] log brightness, A
    is_shown: np.ndarray  # [H, W] bool, the map shows a surface there


@dataclass(frozen=True)
class PixelThresholds:
    """How pixels' thresholds differ from the usual ones."""

    gain: np.ndarray  # [H, W] float32, a
    drift: np.ndarray  # [H, W] float32, b

    @property
    def spread(self) -> float:
        """Standard deviation of the drift among pixels, outliers left out."""
        low, high = np.percentile(self.drift, (16, 84))
        return 0.5 * float(high - low)

    def corrected(self, change: np.ndarray, activity: np.ndarray) -> np.ndarray:  # [H, W] float32
        """Return the change as the pixels' own thresholds say."""
        return change + self.gain * change + self.drift * activity


class _Sums:
    """Sums over the frames of a window, [H, W] each."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.n, self.E, self.A, self.e, self.EE, self.EA, self.AA, self.Ee, self.Ae = np.zeros((9, *shape))

    def add(self, frame: Compared) -> None:
        w = frame.is_shown.astype(np.float64)
        e = w * np.clip(frame.difference, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)
        E, A = w * frame.change, w * frame.activity
        self.n += w
        for total, value in ((self.E, E), (self.A, A), (self.e, e)):
            total += value
        for total, product in ((self.EE, E * E), (self.EA, E * A), (self.AA, A * A)):
            total += product
        self.Ee += E * e
        self.Ae += A * e


def fit_pixel_thresholds(frames: Iterable[Compared], shape: tuple[int, int]) -> PixelThresholds:
    """Return by least squares how pixels' thresholds differ; without a sign of it they do not."""
    total = np.zeros((5, *shape))  # EE, EA, AA, Ee, Ae about the means of each window
    window, sums = -1, _Sums(shape)

    def close() -> None:
        n = np.maximum(sums.n, 1)
        enough = sums.n >= LEAST_FRAMES
        pairs = (
            (sums.EE, sums.E, sums.E), (sums.EA, sums.E, sums.A), (sums.AA, sums.A, sums.A),
            (sums.Ee, sums.E, sums.e), (sums.Ae, sums.A, sums.e),
        )  # fmt: skip
        for k, (product, first, second) in enumerate(pairs):
            total[k] += np.where(enough, product - first * second / n, 0)

    for frame in frames:
        if frame.window != window:
            close()
            window, sums = frame.window, _Sums(shape)
        sums.add(frame)
    close()
    prior = (ERROR / SPREAD) ** 2
    EE, EA, AA, Ee, Ae = total
    EE, AA = EE + prior, AA + prior
    determinant = EE * AA - EA * EA
    gain, drift = (AA * Ee - EA * Ae) / determinant, (EE * Ae - EA * Ee) / determinant
    gain, drift = (_of_single_pixels(np.clip(d, -LARGEST, LARGEST)) for d in (gain, drift))
    return PixelThresholds(gain, drift)


def _of_single_pixels(image: np.ndarray) -> np.ndarray:  # [H, W] -> [H, W] float32
    """Return what is of each pixel alone: what neighbours share are errors of the map."""
    image = image.astype(np.float32)
    return image - cv2.GaussianBlur(image, (0, 0), NEIGHBOURS)
