"""What a run that is fed keeps of its data: what evaluation needs of a recording, within bounded memory."""

from dataclasses import dataclass

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.errors import DataError
from edslam_ti.events import Events


class FedSequence(EventDepthSequence):
    """Stands for the recording: what has been gathered before the first frame.

    The contrast threshold is estimated from it; afterwards only its facts are used.
    """

    truth = None
    contrast_threshold = None

    def __init__(self, camera: Camera, dataset: str, scene: str, description: str, has_events: bool) -> None:
        self.camera, self.dataset, self.scene, self.description = camera, dataset, scene, description
        self.has_events = has_events
        self.depth_timestamps = self.image_timestamps = np.empty(0)
        self._events, self._images = Events.empty(), list[np.ndarray]()

    def gather(
        self,
        events: Events,
        depth_times: list[float],  # seconds
        images: list[tuple[float, np.ndarray]],  # seconds, [H, W] in [0, 1]
    ) -> None:
        """Hold the data before the first frame, until `forget`."""
        self._events, self._images = events, [image for _, image in images]
        self.depth_timestamps = np.array(depth_times)
        self.image_timestamps = np.array([time for time, _ in images])

    def forget(self) -> None:
        """Let go of the data."""
        self._events, self._images = Events.empty(), []
        self.depth_timestamps = self.image_timestamps = np.empty(0)

    @property
    def time_range(self) -> tuple[float, float]:
        if len(self._events) == 0:
            raise DataError(f"{self.scene}: there are no events yet")
        return float(self._events.t[0]), float(self._events.t[-1])

    def events(self, start: float, end: float) -> Events:
        return self._events.between(start, end)

    def depth(self, index: int) -> np.ndarray:  # [H, W] m
        raise DataError(f"{self.scene}: depth images are not kept")

    def image(self, index: int) -> np.ndarray:  # [H, W] in [0, 1]
        return self._images[index]


@dataclass
class _Kept:
    """Samples of one kind that are kept to be compared with the map: every n-th, so that few remain."""

    most: int
    every: int = 1
    seen: int = 0

    def __post_init__(self) -> None:
        self.samples: dict[int, Sample] = {}

    def add(self, k: int, sample: Sample) -> None:
        """Keep the sample of frame k, or not."""
        if self.seen % self.every == 0:
            self.samples[k] = sample
        self.seen += 1
        if len(self.samples) > self.most:
            self.samples = {k: self.samples[k] for k in list(self.samples)[::2]}
            self.every *= 2


class FedSamples:
    """The samples so far (`Samples`); depth and image are kept of a few, evenly spread."""

    def __init__(self, most: int) -> None:  # of held-out frames, and of mapped ones
        self.times: list[float] = []  # seconds
        self._kinds = {is_held_out: _Kept(most) for is_held_out in (False, True)}

    def add(self, sample: Sample, is_held_out: bool) -> None:
        """Add the next sample."""
        if sample.depth is not None:
            bare = Sample(sample.timestamp, Events.empty(), sample.depth, sample.image)
            self._kinds[is_held_out].add(len(self.times), bare)
        self.times.append(sample.timestamp)

    @property
    def held_out(self) -> set[int]:
        """Frames that are kept to measure the map."""
        return set(self._kinds[True].samples)

    @property
    def has_depth(self) -> np.ndarray:  # [S] bool
        has_depth = np.zeros(len(self.times), bool)
        for kept in self._kinds.values():
            has_depth[list(kept.samples)] = True
        return has_depth

    def __len__(self) -> int:
        return len(self.times)

    def without_events(self, k: int) -> Sample:
        """Return sample k, without depth and image where they are not kept."""
        for kept in self._kinds.values():
            if k in kept.samples:
                return kept.samples[k]
        return Sample(self.times[k], Events.empty(), None)
