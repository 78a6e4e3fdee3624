"""Keyframes: which frames the map is built on, and the events kept for them (Sec. III-E)."""

from dataclasses import dataclass

import numpy as np

from edslam_ti.config import KeyframeConfig
from edslam_ti.frame import Frame
from kernels.time_surface import accumulate_polarity


@dataclass(frozen=True)
class Keyframe:
    """A frame the map is optimised for. Its pose is that of the trajectory at `index`."""

    index: int  # of the frame in the trajectory
    timestamp: float  # seconds
    depth: np.ndarray  # [H, W] float32 metres, 0 = missing
    reduced_depth: np.ndarray  # [H / 2, W / 2]


def is_keyframe(
    covisibility: float,  # with the last keyframe, 0 to 1
    translation: float,  # from the last keyframe, metres
    median_depth: float,  # metres
    config: KeyframeConfig,
) -> bool:
    """Return whether a frame sees enough that is new to become a keyframe."""
    is_far = translation > config.max_translation * median_depth
    return covisibility < config.min_covisibility or is_far


class EventArchive:
    """Accumulated polarity between any two of its times: the measured side of Eq. 11, ready to use.

    Of every chunk it keeps the sum of polarities up to its start; of chunks in the window also the
    sums at a few times inside. `forget_details` drops the latter, so that memory is bounded by the
    keyframes and one image per chunk, not by the number of events.
    """

    def __init__(self, shape: tuple[int, int], bins_per_chunk: int) -> None:
        self._bins = bins_per_chunk
        self._total = np.zeros(shape, np.int16)  # sum of polarities so far
        self._before: list[np.ndarray] = []  # [H, W] int16 of each chunk: total at its start
        self._inside: list[np.ndarray | None] = []  # [bins, H, W] int16: running sums within the chunk
        self.edges: list[np.ndarray] = []  # [bins + 1] seconds of each chunk

    def __len__(self) -> int:
        return len(self.edges)

    def append(self, frame: Frame) -> None:
        """Add the event chunk that ends at `frame`."""
        edges = np.linspace(frame.previous_timestamp, frame.timestamp, self._bins + 1)
        events = frame.events
        first = np.searchsorted(events.t, edges)
        sums = accumulate_polarity(events.x, events.y, events.polarity, first, self._total.shape)
        running = np.cumsum(sums, axis=0, dtype=np.int16)
        self._before.append(self._total)
        self._inside.append(running)
        self.edges.append(edges)
        self._total = self._total + running[-1]

    def forget_details(self, keep: set[int]) -> None:
        """Keep times inside chunks only for those in `keep`."""
        for chunk in range(len(self)):
            if chunk not in keep:
                self._inside[chunk] = None

    def times(self, chunk: int) -> np.ndarray:
        """Return the times of a chunk at which sums are known, its start included, its end not."""
        return self.edges[chunk][:-1] if self._inside[chunk] is not None else self.edges[chunk][:1]

    def sum_before(self, chunk: int, bin_index: int) -> np.ndarray:  # [H, W] int16
        """Return the sum of polarities from the beginning to the given edge of a chunk."""
        if bin_index == 0:
            return self._before[chunk]
        inside = self._inside[chunk]
        assert inside is not None
        return self._before[chunk] + inside[bin_index - 1]
