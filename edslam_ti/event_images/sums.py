"""Sums of polarities up to many moments, from which the change between any two of them follows (Eq. 11).

A recording's events are far too many to be added up anew for every step of an optimisation. Each chunk is
divided at moments (knots); the sums up to these are kept, and a difference of two sums is the change between
them. Sums are 16-bit integers that wrap around; their differences are right nevertheless, as long as they
stay below 655 thresholds.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from edslam_ti.event_images.noisy import NoisyPixels
from edslam_ti.events import Events
from edslam_ti.frame import EventCounts, Frame

STEPS = 50  # units of a sum in one threshold, so that C+ and C- may differ by hundredths


@dataclass(frozen=True)
class Knot:
    """A moment, and what had happened until then."""

    time: float  # seconds
    num_events: int  # since the first frame
    sums: Tensor  # [H, W] int16, units


class EventSums:
    """Sums of polarities at the knots of every chunk that is kept."""

    def __init__(
        self,
        shape: tuple[int, int],  # (H, W)
        positive: float,  # C+, log brightness
        negative: float,  # C-
        knots_per_frame: int,
        device: str = "cpu",
    ) -> None:
        mean = 0.5 * (positive + negative)
        self._unit = mean / STEPS  # log brightness
        self._worth = round(STEPS * positive / mean), round(STEPS * negative / mean)  # units of an event
        self._knots_per_frame = knots_per_frame
        self._device = device
        self._sums = torch.zeros(shape, dtype=torch.int16, device=device)
        self._num_events = 0
        self._chunks: dict[int, list[Knot]] = {}  # by frame, in order of time
        self.noisy_pixels = NoisyPixels(shape)

    @property
    def frames(self) -> list[int]:
        """Frames whose chunks are kept, in order of time."""
        return list(self._chunks)

    def knots(self, index: int) -> list[Knot]:
        """Return the knots of a frame's chunk, in order of time; the last one is at the frame itself."""
        return self._chunks[index]

    def add(self, frame: Frame, index: int) -> None:
        """Add a frame's events; there is no knot at a frame that is held out."""
        self.noisy_pixels.add(frame.event_counts)
        number = self._knots_per_frame
        start, end = frame.previous_timestamp, frame.timestamp
        times = np.linspace(start, end, number + 1)[1:] if end > start else np.array([end])
        cuts = np.searchsorted(frame.events.t, times[:-1])
        bounds = [0, *cuts.tolist(), len(frame.events)]
        knots = []
        for time, first, past in zip(times, bounds, bounds[1:]):
            part = frame.events[first:past]
            self._sums = self._sums + self._change_of(part)
            self._num_events += len(part)
            knots.append(Knot(float(time), self._num_events, self._sums))
        self._chunks[index] = knots[:-1] if frame.is_held_out else knots

    def drop(self, index: int) -> None:
        """Forget the knots of a frame's chunk."""
        del self._chunks[index]

    def change(self, start: Knot, end: Knot) -> Tensor:  # [H, W] float32
        """Return the change of log brightness between two knots."""
        return (end.sums - start.sums).float() * self._unit

    def _change_of(self, events: Events) -> Tensor:  # [H, W] int16, units
        """Return the change by some events; noisy pixels get the median of their neighbours."""
        counts = torch.from_numpy(EventCounts(events, self.noisy_pixels.mask.shape).numbers).to(self._device)
        positive, negative = self._worth
        change = (positive * counts[..., 1] - negative * counts[..., 0]).to(torch.int16)
        if self.noisy_pixels.mask.any():
            replaced = self.noisy_pixels.replaced(change.cpu().numpy().astype(np.float32))
            change = torch.from_numpy(replaced).to(self._device, torch.int16)
        return change
