"""A recording as a worse sensor would have made it: noisy or sparser depth, stretches without data."""

import numpy as np

from edslam_ti.datasets import EventDepthSequence
from edslam_ti.errors import DataError
from edslam_ti.events import Events
from edslam_ti.simulation.depth_noise import kinect_depth, viewing_cosine

Gap = tuple[float, float]  # seconds from the sequence's clock, start and length


class AlteredSequence(EventDepthSequence):
    """A sequence with exact depth, altered while it is read; the recording on disk stays as it is.

    `noise` "kinect" adds a structured-light camera's noise, the same for one `seed`. `depth_rate` (Hz)
    leaves out depth images, `event_gap` and `depth_gap` all data of a stretch.
    """

    def __init__(
        self,
        sequence: EventDepthSequence,
        noise: str = "none",
        depth_rate: float | None = None,
        event_gap: Gap | None = None,
        depth_gap: Gap | None = None,
        seed: int = 0,
    ) -> None:
        if noise not in ("none", "kinect"):
            raise DataError(f"depth noise: expected none or kinect, got '{noise}'")
        self._sequence = sequence
        self._noise = noise
        self._seed = seed
        self._event_gap = event_gap
        self.dataset, self.scene, self.camera = sequence.dataset, sequence.scene, sequence.camera
        self.contrast_threshold = sequence.contrast_threshold
        self.truth = sequence.truth
        self.image_timestamps = sequence.image_timestamps
        self.description = sequence.description
        self.surfaces_file = sequence.surfaces_file
        self.time_offset = sequence.time_offset
        stamps = sequence.depth_timestamps
        kept = _thinned(stamps, depth_rate)
        if depth_gap is not None:
            start, length = depth_gap
            times = stamps[kept] + 1e-9  # stamps are rounded: 0.3 is not less than 0.2 + 0.1
            kept = kept[(times < start) | (times >= start + length)]
        self._kept = kept  # [D] indices of depth images
        self.depth_timestamps = stamps[kept]

    @property
    def time_range(self) -> tuple[float, float]:
        return self._sequence.time_range

    def events(self, start: float, end: float) -> Events:
        if self._event_gap is None:
            return self._sequence.events(start, end)
        gap_start, length = self._event_gap
        gap_end = gap_start + length
        parts = [
            self._sequence.events(a, b)
            for a, b in ((start, min(end, gap_start)), (max(start, gap_end), end))
            if b > a
        ]
        return Events.concatenate(parts)

    def depth(self, index: int) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
        depth = self._sequence.depth(int(self._kept[index]))
        if self._noise == "none":
            return depth
        milliseconds = round(1000 * float(self.depth_timestamps[index]))
        rng = np.random.default_rng([self._seed, milliseconds])
        return kinect_depth(depth, viewing_cosine(depth, self.camera), self.camera, rng)

    def image(self, index: int) -> np.ndarray:  # [H, W] float32 in [0, 1]
        return self._sequence.image(index)


def _thinned(stamps: np.ndarray, rate: float | None) -> np.ndarray:  # [D] s -> indices
    """Return the stamps kept at a rate: the first, then each that is a period (to 2 %) after the last."""
    kept: list[int] = []
    for k, t in enumerate(stamps):
        if rate is None or not kept or t - stamps[kept[-1]] >= 0.98 / rate:
            kept.append(k)
    return np.array(kept, int)
