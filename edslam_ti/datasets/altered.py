"""A recording as a worse sensor would have made it: noisy or sparser depth, gaps in the data."""

from dataclasses import replace

import numpy as np

from edslam_ti.datasets.base import EventDepthSequence, NovelView, WrappedSequence
from edslam_ti.errors import DataError
from edslam_ti.events import Events
from edslam_ti.simulation.depth_noise import kinect_depth, viewing_cosine
from edslam_ti.trajectory import Trajectory

Gap = tuple[float, float]  # start on the sequence's clock and length, seconds
SAME_POSE = 1e-3  # metres, entries of rotation matrices


class AlteredSequence(WrappedSequence):
    """A sequence with exact depth, altered while it is read; the recording on disk stays unchanged.

    `noise` "kinect" adds a structured-light camera's noise, reproducible for one `seed`. `depth_rate` (Hz)
    leaves out depth images; `event_gap` and `depth_gap` leave out all data of an interval.
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
        super().__init__(sequence)
        self._noise = noise
        self._seed = seed
        self._event_gap = event_gap
        stamps = sequence.depth_timestamps
        kept = _thinned(stamps, depth_rate)
        if depth_gap is not None:
            start, length = depth_gap
            times = stamps[kept] + 1e-9  # stamps are rounded: 0.3 is not less than 0.2 + 0.1
            kept = kept[(times < start) | (times >= start + length)]
        self._kept = kept  # [D] indices of depth images
        self.depth_timestamps = stamps[kept]

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


class RepeatedSequence(WrappedSequence):
    """A recording that ends where it began, played several times in a row to make a longer stream."""

    def __init__(self, sequence: EventDepthSequence, rounds: int) -> None:
        truth = sequence.truth
        apart = np.inf if truth is None else np.abs(truth.pose(-1) - truth.pose(0)).max()
        if truth is None or apart > SAME_POSE:
            raise DataError(
                f"{sequence.scene}: expected true poses that end where they begin, to play it again, got "
                f"{'none' if truth is None else f'a difference of {apart:.3g}'}; record a loop (--path loop)"
            )
        super().__init__(sequence)
        self._start = float(truth.timestamps[0])
        self._period = float(truth.timestamps[-1] - truth.timestamps[0])
        self.description = f"{sequence.description}, {rounds} times in a row"
        self._rounds = rounds
        self.depth_timestamps, self._depth = self._repeated(sequence.depth_timestamps)
        self.image_timestamps, self._image = self._repeated(sequence.image_timestamps)
        stamps, index = self._repeated(truth.timestamps)
        self.truth = Trajectory(stamps, truth.poses[index])

    @property
    def time_range(self) -> tuple[float, float]:
        first, last = self._sequence.time_range
        return first, last + (self._rounds - 1) * self._period

    def events(self, start: float, end: float) -> Events:
        parts = []
        for k in range(self._rounds):
            shift, is_last = k * self._period, k == self._rounds - 1
            until = end - shift if is_last else min(end - shift, self._start + self._period)
            part = self._sequence.events(max(start - shift, self._start) if k else start, until)
            parts.append(replace(part, t=part.t + shift))
        return Events.concatenate(parts)

    def depth(self, index: int) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
        return self._sequence.depth(int(self._depth[index]))

    def image(self, index: int) -> np.ndarray:  # [H, W] float32 in [0, 1]
        return self._sequence.image(int(self._image[index]))

    def novel_views(self) -> list[NovelView]:
        views = self._sequence.novel_views()
        return [
            replace(view, timestamp=view.timestamp + k * self._period)
            for k in range(self._rounds)
            for view in views
        ]

    def _repeated(self, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # [N] s -> [M] s, [M] indices
        """Return the stamps of all rounds, and the index of each in the recording."""
        times = np.concatenate([stamps + k * self._period for k in range(self._rounds)])
        indices = np.tile(np.arange(len(stamps)), self._rounds)
        is_new = np.diff(times, prepend=-np.inf) > 1e-6  # a round starts at the end of the previous one
        return times[is_new], indices[is_new]


def _thinned(stamps: np.ndarray, rate: float | None) -> np.ndarray:  # [D] s -> indices
    """Return the stamps kept at a rate: each is at least a period (to 2 %) after the one kept before."""
    kept: list[int] = []
    for k, t in enumerate(stamps):
        if rate is None or not kept or t - stamps[kept[-1]] >= 0.98 / rate:
            kept.append(k)
    return np.array(kept, int)
