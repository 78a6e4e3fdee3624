"""Compares events with grey images: swapped axes, mirrored images, inverted polarity, an offset of clocks.

Between two images the log brightness of a pixel changes by C times the signed number of its events (Eq. 11).
The correlation of the two over all pixels is above 0.8 for a good recording, near 0 if one is mirrored or
transposed, negative if polarity is inverted, and highest where the clocks agree.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from edslam_ti.datasets import EventDepthSequence, WrappedSequence
from edslam_ti.events import Events
from edslam_ti.inspection.event_volume import EventVolume
from edslam_ti.inspection.findings import Finding

MOST_PAIRS = 25
LONGEST_PAIR = 0.3  # s between the two images
SHIFTS = np.arange(-0.12, 0.1201, 0.005)  # s
EPSILON = 0.02  # added to brightness before the logarithm
CLIP = 3.0  # standard deviations, so that hot pixels do not decide
FITS, UNLIKE, CLEARLY = 0.45, 0.25, 2.0  # correlations: of a good reading, of a wrong one, and their ratio
LAG = 0.09  # an event comes this share of the time between a pixel's events after the change, measured

Transform = Callable[[np.ndarray], np.ndarray]  # [H, W] -> [H', W']


def _transposed(image: np.ndarray) -> np.ndarray:
    side = min(image.shape)
    return image[:side, :side].T


TRANSFORMS: dict[str, tuple[str, Transform]] = {  # fault, undoing it
    "swap x and y": ("swapped_axes", _transposed),
    "mirror x (x = width - 1 - x)": ("mirrored_events", lambda image: image[:, ::-1]),
    "mirror y (y = height - 1 - y)": ("mirrored_events", lambda image: image[::-1]),
    "turn by 180 degrees (mirror x and y)": ("mirrored_events", lambda image: image[::-1, ::-1]),
}


class TransformedEvents(WrappedSequence):
    """A sequence whose events are mirrored or transposed, as a name of `TRANSFORMS` says."""

    def __init__(self, sequence: EventDepthSequence, name: str) -> None:
        super().__init__(sequence)
        self._name = name

    def events(self, start: float, end: float) -> Events:
        events, (height, width) = self._sequence.events(start, end), self.camera.shape
        if "swap" in self._name:
            side = min(height, width)
            events = events[(events.x < side) & (events.y < side)]
            return replace(events, x=events.y.copy(), y=events.x.copy())
        if "x = " in self._name or "x and y" in self._name:
            events = replace(events, x=np.asarray(width - 1 - events.x, np.int16))
        if "y = " in self._name or "x and y" in self._name:
            events = replace(events, y=np.asarray(height - 1 - events.y, np.int16))
        return events


@dataclass(frozen=True)
class ImageCheck:
    """How events fit images."""

    correlation: float  # -1 to 1, at the best shift
    offset: float  # s, by which stamps of events are late against those of images
    tolerance: float  # s; a smaller offset may be the events' own lag
    findings: tuple[Finding, ...]

    @property
    def is_good(self) -> bool:
        """Whether the two belong together, so that the offset means something."""
        return not self.findings and self.correlation > FITS


def check_images(sequence: EventDepthSequence, volume: EventVolume) -> ImageCheck | None:
    """Return how events fit the images of a part of a recording; None: too few images or events."""
    pairs = _pairs(sequence, volume)
    if len(pairs) < 2:
        return None
    at_zero = _correlation(volume, pairs, lambda image: image, 0.0)
    values = np.array([_correlation(volume, pairs, lambda image: image, float(s)) for s in SHIFTS])
    shift, best = _peak(values)
    if not np.isfinite(values).all():
        return None
    others = {name: _correlation(volume, pairs, undo, 0.0) for name, (_, undo) in TRANSFORMS.items()}
    findings: list[Finding] = []
    name = max(others, key=lambda key: abs(others[key]))
    own = max(abs(at_zero), abs(best), abs(float(values.min())))
    if abs(others[name]) > FITS and abs(others[name]) > CLEARLY * own:
        fault = TRANSFORMS[name][0]
        what = "x and y look swapped in the events" if fault == "swapped_axes" else "the events look mirrored"
        findings.append(
            Finding(
                fault,
                f"{what}: their changes of brightness correlate with those of the images at "
                f"{others[name]:.2f} after this change, at {at_zero:.2f} as they are: {name} of the events",
            )
        )
    low = int(values.argmin())
    if not findings and values[low] < -FITS and abs(values[low]) > CLEARLY * max(best, 0.0):
        findings.append(
            Finding(
                "inverted_polarity",
                f"polarity looks inverted: images become darker where events say brighter (correlation "
                f"{values[low]:.2f}): swap the polarity of the events",
            )
        )
    if not findings and own < UNLIKE:
        findings.append(
            Finding(
                "unrelated_images",
                f"images do not show what the events show (correlation {own:.2f}, usually above 0.8): are "
                "they of the same camera, undistorted, and on the same clock?",
            )
        )
    lag = LAG * _time_between_events(volume)
    return ImageCheck(best, shift - lag, 0.008 + lag, tuple(findings))


def _pairs(
    sequence: EventDepthSequence, volume: EventVolume
) -> list[tuple[float, float, np.ndarray]]:  # s, s, [H, W]
    """Return the times of pairs of images, and the change of log brightness between the two."""
    stamps = sequence.image_timestamps
    inside = np.flatnonzero((stamps >= volume.start) & (stamps <= volume.end))
    pairs = []
    logs: dict[int, np.ndarray | None] = {}
    step = max(1, -(-(len(inside) - 1) // MOST_PAIRS))
    size = volume.camera.width, volume.camera.height
    for a, b in list(itertools.pairwise(inside))[::step]:
        if stamps[b] - stamps[a] > LONGEST_PAIR:
            continue
        for k in (int(a), int(b)):
            if k not in logs:
                image = sequence.image_or_none(k)
                small = None if image is None else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
                logs[k] = None if small is None else np.log(small + np.float32(EPSILON))
        before, after = logs[int(a)], logs[int(b)]
        if before is not None and after is not None:
            pairs.append((float(stamps[a]), float(stamps[b]), after - before))
    return pairs


def _correlation(
    volume: EventVolume, pairs: list[tuple[float, float, np.ndarray]], undo: Transform, shift: float
) -> float:
    """Return the correlation over all pairs of the changes by events, `shift` later, and by images."""
    product = own = others = 0.0
    for start, end, change in pairs:
        if start + shift < volume.start or end + shift > volume.end:
            continue
        counted = undo(volume.change(start + shift, end + shift))
        height, width = np.minimum(counted.shape, change.shape)
        a, b = (_smoothed(image[:height, :width]) for image in (counted, change))
        product += float((a * b).sum())
        own, others = own + float((a * a).sum()), others + float((b * b).sum())
    return product / np.sqrt(own * others) if own * others > 0 else 0.0


def _smoothed(image: np.ndarray) -> np.ndarray:  # [H, W]
    blurred = cv2.GaussianBlur(np.ascontiguousarray(image), (0, 0), 1)
    limit = CLIP * float(blurred.std())
    return np.clip(blurred, -limit, limit)


def _peak(values: np.ndarray) -> tuple[float, float]:
    """Return the shift (s) of the highest correlation, between the shifts that were tried, and its value."""
    k = int(values.argmax())
    shift = float(SHIFTS[k])
    if 0 < k < len(values) - 1:
        curvature = values[k - 1] - 2 * values[k] + values[k + 1]
        if curvature < 0:
            shift += float(0.5 * (values[k - 1] - values[k + 1]) / curvature) * float(SHIFTS[1] - SHIFTS[0])
    return shift, float(values[k])


def _time_between_events(volume: EventVolume) -> float:
    """Return the mean time (s) between two events of a pixel, as an event sees it."""
    number = volume.number(volume.start, volume.end) / volume.factor**2
    total = float(number.sum())
    return (volume.end - volume.start) * total / max(float((number * number).sum()), 1e-9) if total else 0.0
