"""Keyframes: which frames the map is built on, and the events kept for them (Sec. III-E)."""

from dataclasses import dataclass

import numpy as np

from edslam_ti.config import KeyframeConfig
from edslam_ti.events import Events
from edslam_ti.kernels.time_surface import count_events


@dataclass(frozen=True)
class Keyframe:
    """A frame the map is optimised for. Its pose is that of the trajectory at `index`."""

    index: int  # of the frame in the trajectory
    timestamp: float  # seconds


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
    """What events say has changed at every pixel since a beginning, at the times of frames (Eq. 11).

    Between two events a pixel's brightness lies within a threshold of the last event's level, and on
    average 0.2 thresholds further in the direction of the last event and of the next one each (measured on
    simulated rooms; without it, contrast comes out too small).
    """

    STEPS = 50  # units of the stored images in one threshold
    LEAN = 0.2  # thresholds

    def __init__(
        self,
        shape: tuple[int, int],
        positive: float = 1.0,  # what an event of either polarity stands for, in (mean) thresholds
        negative: float = 1.0,
    ) -> None:
        # Units an event; not rounded, because sums grow
        self._positive, self._negative = self.STEPS * positive, self.STEPS * negative
        self._level = np.zeros(shape, np.float32)  # units, of events since the beginning
        self._last = np.zeros(shape, np.int16)  # units, towards which the last event leans
        self._last_frame = np.zeros(shape, np.int32)  # frames up to this one know their next event
        self._images: dict[int, np.ndarray] = {}  # [H, W] int16 by frame

    def __len__(self) -> int:
        return len(self._images)

    @property
    def frames(self) -> list[int]:
        """Frames whose images are kept, in order of time."""
        return list(self._images)

    def append(self, events: Events, index: int, is_kept: bool) -> None:
        """Add the events up to frame `index`; keep the change up to it, if wanted."""
        shape = self._level.shape
        first, last = np.zeros(shape, np.int8), np.zeros(shape, np.int8)  # polarities, 0 where silent
        # Of repeated pixels the last one stays: backwards, the first event.
        first.ravel()[(events.y.astype(np.int64) * shape[1] + events.x)[::-1]] = events.polarity[::-1]
        counts = np.zeros((*shape, 2), np.int32)
        count_events(events.x, events.y, events.polarity, counts, last)
        fired = np.flatnonzero(first)
        self._lean_towards_next(fired, self._lean(first.ravel()[fired]))
        self._level += np.float32(self._positive) * counts[..., 1]
        self._level -= np.float32(self._negative) * counts[..., 0]
        self._last.ravel()[fired] = self._lean(last.ravel()[fired])
        self._last_frame.ravel()[fired] = index
        if is_kept:
            self._images[index] = np.rint(self._level).astype(np.int16) + self._last

    def _lean(self, polarity: np.ndarray) -> np.ndarray:  # [P] -> [P] int16
        """Return by how many units brightness is beyond an event's level."""
        worth = np.where(polarity > 0, self._positive, -self._negative)
        return np.rint(self.LEAN * worth).astype(np.int16)

    def _lean_towards_next(self, pixels: np.ndarray, lean: np.ndarray) -> None:
        """Let the kept images since each pixel's last event, mostly few, lean [P] towards its next one."""
        last_frame = self._last_frame.ravel()[pixels]
        for frame in reversed(self._images):
            is_waiting = last_frame <= frame
            pixels, lean, last_frame = pixels[is_waiting], lean[is_waiting], last_frame[is_waiting]
            if len(pixels) == 0:
                return
            self._images[frame].ravel()[pixels] += lean

    def change(self, index: int) -> np.ndarray:  # [H, W] float32
        """Return the change from the beginning to a kept frame, in contrast thresholds."""
        return self._images[index].astype(np.float32) / self.STEPS

    def forget(self, index: int) -> None:
        """Give up a frame's image."""
        del self._images[index]

    def begin_again(self) -> np.ndarray:  # [H, W] float32
        """Count from here on anew; return what has changed up to here. Kept images stay as they are."""
        change = (self._level + self._last).astype(np.float32) / self.STEPS
        self._level[:] = 0
        return change
