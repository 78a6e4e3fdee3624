"""Removes motion blur from grey images with the events of their exposure.

An image is the mean of brightness over its exposure, for a moving camera a mean over the poses of Eq. 9.
Instead of rendering the map from many poses, we undo the mean with events (event double integral, Pan et
al. 2019). Let a be the start of the exposure and E(t) the change of log brightness since a (Eq. 11). Then

    B = I(a) * mean_t exp E(t)        so        log I(t) = log B - log mean_t exp E(t) + E(t)

at any time t close to the exposure, such as the time of the next frame.
"""

from dataclasses import dataclass

import numpy as np

from edslam_ti.config import MappingConfig
from edslam_ti.datasets.base import EventDepthSequence
from edslam_ti.errors import DataError
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.events import Events
from edslam_ti.frame import Frame

SAME_TIME = 1e-3  # seconds; an image this close to a frame has the frame's time
DARKEST, BRIGHTEST = 1 / 255, 254 / 255  # grey values from here outwards only bound brightness (clipped)


@dataclass(frozen=True)
class SharpImage:
    """Log brightness measured by a grey image."""

    log_brightness: np.ndarray  # [H, W] float32
    clipped: np.ndarray  # [H, W] int8: 0 exact, -1 an upper bound, 1 a lower bound

    def imposed_on(self, image: np.ndarray) -> np.ndarray:
        """Return another estimate of log brightness [H, W], corrected to agree with this one."""
        low = np.where(self.clipped < 0, np.float32(-np.inf), self.log_brightness)
        high = np.where(self.clipped > 0, np.float32(np.inf), self.log_brightness)
        return np.clip(image, low, high)


class SharpImages:
    """Log brightness at the times of frames, from a sequence's grey images.

    Half of an image's exposure comes after its time, so the result is available that much later.
    """

    def __init__(
        self, sequence: EventDepthSequence, contrast: ContrastThreshold, config: MappingConfig
    ) -> None:
        if len(sequence.image_timestamps) == 0:
            raise DataError(
                f"{sequence.scene}: mapping.frames: expected a sequence with grey images, got one without; "
                "add the images or leave out --mapping.frames"
            )
        self._sequence = sequence
        self._steps = contrast.by_polarity  # log brightness of an event, + and -
        self._exposure = config.exposure if config.exposure is not None else sequence.exposure or 0.0
        self._epsilon = np.float32(config.log_epsilon)

    def at(self, frame: Frame) -> SharpImage | None:
        """Return log(brightness + epsilon) at a frame's time, None without an image in its event chunk."""
        taken = self._taken_in(frame)
        if taken is None:
            return None
        image, time = self._sequence.image_or_none(taken), float(self._sequence.image_timestamps[taken])
        if image is None:
            return None
        clipped = (image >= BRIGHTEST).astype(np.int8) - (image <= DARKEST)
        log_image = np.log(image + self._epsilon) + self._correction(time, frame.timestamp, image.shape)
        return SharpImage(log_image.astype(np.float32), clipped)

    def _taken_in(self, frame: Frame) -> int | None:
        """Return the last image in the frame's event chunk, which no other frame's chunk shares."""
        after = min(frame.previous_timestamp, frame.timestamp - 2 * SAME_TIME) + SAME_TIME
        stamps = self._sequence.image_timestamps
        last = int(np.searchsorted(stamps, frame.timestamp + SAME_TIME, side="right")) - 1
        return last if last >= 0 and stamps[last] > after else None

    def _correction(self, taken: float, time: float, shape: tuple[int, ...]) -> np.ndarray:  # [H, W]
        """Return the log brightness at `time` minus that of an image centred on `taken`."""
        start, end = taken - self._exposure / 2, taken + self._exposure / 2
        events = self._sequence.events(min(start, time), max(end, time))
        step = np.where(events.polarity > 0, self._steps[0], -self._steps[1])
        return change_from_mean(events, step, (start, end), time, (shape[0], shape[1]))


def change_from_mean(
    events: Events,  # N; all from min(start, time) to max(end, time)
    step: np.ndarray,  # [N] change of log brightness by each event
    exposure: tuple[float, float],  # start and end, seconds
    time: float,  # seconds
    shape: tuple[int, int],
) -> np.ndarray:  # [H, W] float64
    """Return the log of the ratio of brightness at `time` to its mean during the exposure."""
    start, end = exposure
    pixel = events.y.astype(np.int64) * shape[1] + events.x
    size = shape[0] * shape[1]
    # Each event lifts the rest of the exposure from one level to the next.
    before = _sums_before(pixel, step)
    rest = np.clip((end - events.t) / max(end - start, 1e-9), 0, 1)
    mean = 1 + np.bincount(pixel, rest * np.exp(before) * np.expm1(step), size)
    until = np.bincount(pixel, step * (events.t < time), size)
    return np.asarray(until - np.log(mean)).reshape(shape)


def _sums_before(pixel: np.ndarray, step: np.ndarray) -> np.ndarray:  # [N], [N] -> [N]
    """Return the sum of the earlier steps of each event's pixel."""
    if len(pixel) == 0:
        return np.zeros(0)
    order = np.argsort(pixel, kind="stable")
    before = np.cumsum(step[order]) - step[order]
    is_first = np.diff(pixel[order], prepend=-1) != 0
    sums = np.empty(len(pixel))
    sums[order] = before - before[is_first][np.cumsum(is_first) - 1]
    return sums
