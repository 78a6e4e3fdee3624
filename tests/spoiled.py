"""A good sequence with one fault, as recordings of users have them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.datasets import EventDepthSequence, WrappedSequence
from edslam_ti.events import Events
from edslam_ti.geometry import inverse
from edslam_ti.trajectory import Trajectory

LATE = 0.03  # s


class Spoiled(WrappedSequence):
    """A sequence whose events, depth or stamps are changed by functions."""

    def __init__(
        self,
        sequence: EventDepthSequence,
        events: Callable[[Events], Events] = lambda events: events,
        depth: Callable[[np.ndarray], np.ndarray] = lambda depth: depth,
        **attributes: object,
    ) -> None:
        super().__init__(sequence)
        self._change_events, self._change_depth = events, depth
        for name, value in attributes.items():
            setattr(self, name, value)

    def events(self, start: float, end: float) -> Events:
        return self._change_events(self._sequence.events(start, end))

    def depth(self, index: int) -> np.ndarray:
        return self._change_depth(self._sequence.depth(index))


class LateEvents(WrappedSequence):
    """A sequence whose events' stamps are late."""

    @property
    def time_range(self) -> tuple[float, float]:
        first, last = self._sequence.time_range
        return first + LATE, last + LATE

    def events(self, start: float, end: float) -> Events:
        events = self._sequence.events(start - LATE, end - LATE)
        return replace(events, t=events.t + LATE)


def with_truth(
    sequence: EventDepthSequence, change: Callable[[np.ndarray], np.ndarray]
) -> EventDepthSequence:
    """Return a sequence with changed true poses."""
    assert sequence.truth is not None
    truth = Trajectory(sequence.truth.timestamps, change(sequence.truth.poses))
    return Spoiled(sequence, truth=truth)


def as_wxyz(poses: np.ndarray) -> np.ndarray:  # [N, 4, 4]
    """Return poses as they come out if quaternions w x y z are read as x y z w."""
    x, y, z, w = Rotation.from_matrix(poses[:, :3, :3]).as_quat().T
    result = poses.copy()
    result[:, :3, :3] = Rotation.from_quat(np.stack([w, x, y, z], -1)).as_matrix()
    return result


def spoiled(sequence: EventDepthSequence, fault: str) -> EventDepthSequence:
    """Return a sequence with the fault of that name in FAULTY."""
    return FAULTY[fault][1](sequence)


def _swapped(events: Events, side: int) -> Events:
    kept = events[(events.x < side) & (events.y < side)]
    return replace(kept, x=kept.y.copy(), y=kept.x.copy())


def _hot(events: Events) -> Events:
    """Add two pixels that fire every millisecond."""
    if len(events) == 0:
        return events
    t = np.arange(np.ceil(1000 * events.t[0]), 1000 * events.t[-1]) / 1000
    x, y = np.tile([17, 60], len(t)).astype(np.int16), np.tile([20, 51], len(t)).astype(np.int16)
    both = Events.concatenate([events, Events(x, y, np.repeat(t, 2), np.ones(2 * len(t), np.int8))])
    return both[np.argsort(both.t, kind="stable")]


# Name: the kind that is to be named, and how to make it.
FAULTY: dict[str, tuple[str, Callable[[EventDepthSequence], EventDepthSequence]]] = {
    "events late": ("events_clock", LateEvents),
    "depth late": ("depth_clock", lambda s: Spoiled(s, depth_timestamps=s.depth_timestamps + LATE)),
    "images late": ("images_clock", lambda s: Spoiled(s, image_timestamps=s.image_timestamps + LATE)),
    "axes swapped": ("swapped_axes", lambda s: Spoiled(s, lambda e: _swapped(e, s.camera.height))),
    "events mirrored": (
        "mirrored_events",
        lambda s: Spoiled(s, lambda e: replace(e, x=(s.camera.width - 1 - e.x).astype(np.int16))),
    ),
    "polarity inverted": (
        "inverted_polarity",
        lambda s: Spoiled(s, lambda e: replace(e, polarity=-e.polarity)),
    ),
    "gap": ("event_gap", lambda s: Spoiled(s, lambda e: e[(e.t < 0.3) | (e.t > 0.4)])),
    "hot pixels": ("hot_pixels", lambda s: Spoiled(s, _hot)),
    "depth too large": ("truth_scale", lambda s: Spoiled(s, depth=lambda d: d * np.float32(5))),
    "depth mirrored": ("mirrored_depth", lambda s: Spoiled(s, depth=lambda d: d[:, ::-1].copy())),
    "depth frozen": ("frozen_depth", lambda s: Spoiled(s, depth=lambda d: s.depth(0))),
    "truth inverse": ("truth_convention", lambda s: with_truth(s, inverse)),
    "truth OpenGL": (
        "truth_convention",
        lambda s: with_truth(s, lambda T: T @ np.diag([1.0, -1, -1, 1])),
    ),
    "truth wxyz": ("truth_convention", lambda s: with_truth(s, as_wxyz)),
}
