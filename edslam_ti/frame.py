"""A sample as tracking and mapping see it."""

from dataclasses import dataclass

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import Sample
from edslam_ti.events import Events


@dataclass(frozen=True)
class Frame:
    """The end of an event chunk: everything tracking and mapping see of it."""

    timestamp: float  # seconds
    previous_timestamp: float  # seconds, start of its event chunk
    events: Events  # of its chunk
    camera: Camera
    depth: np.ndarray | None  # [H, W] float32 metres, 0 = missing
    image: np.ndarray | None  # [H, W] float32 in [0, 1]; only RGB-D baselines look at it
    is_held_out: bool = False  # kept from mapping, for evaluation


class FrameBuilder:
    """Turns samples into frames; they must come in order of time."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._previous: float | None = None

    def build(self, sample: Sample, is_held_out: bool = False) -> Frame:
        """Return the frame at the end of the sample."""
        start = sample.timestamp if self._previous is None else self._previous
        self._previous = sample.timestamp
        return Frame(
            timestamp=sample.timestamp,
            previous_timestamp=start,
            events=sample.events,
            camera=self._camera,
            depth=sample.depth,
            image=sample.image,
            is_held_out=is_held_out,
        )
