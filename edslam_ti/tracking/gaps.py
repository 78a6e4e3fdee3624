"""Gaps in the event stream: detecting one, and correcting the poses inside it afterwards."""

import numpy as np

from edslam_ti.geometry import inverse, is_near, se3_exp, se3_log
from edslam_ti.trajectory import PathDraft

# Metres, degrees: if the correction after a gap is smaller, alignment of depth has worked inside it. Not a
# setting: it only chooses between two ways to distribute the correction.
CARRIED_BY_DEPTH = (0.02, 2.0)


class EventRate:
    """Numbers of events per frame: the usual one, and those of the last two frames."""

    def __init__(self, silent_share: float, slowing_share: float) -> None:
        """Below these shares of the usual number of events a frame is silent, or the camera slowing."""
        self._silent_share, self._slowing_share = silent_share, slowing_share
        self._usual = 0.0  # events a frame, a running mean without silent frames
        self._last, self._before = 0, 0

    def add(self, count: int) -> None:
        """Add the number of events of the next frame."""
        self._before, self._last = self._last, count
        if not self.is_silent:
            self._usual = count if self._usual == 0 else 0.9 * self._usual + 0.1 * count

    @property
    def is_silent(self) -> bool:
        """Whether the last frame had next to no events."""
        return self._last < self._silent_share * self._usual

    @property
    def was_slowing(self) -> bool:
        """Whether the frame before also had few events, as when a camera comes to rest."""
        return self._before < self._slowing_share * self._usual


def bridge(
    path: PathDraft,
    before: int,  # last frame before the gap
    after: int,  # first frame after it
    correction: np.ndarray,  # [4, 4] T_new T_old^-1 of the frames after the gap
) -> None:
    """Correct all frames after a gap, and distribute the correction over the frames inside it.

    Poses inside the gap come from alignment of depth alone. If the correction is large, that has failed, as
    along a plain wall. Then the poses inside are replaced by a cubic through both ends and their velocities.
    """
    for index in range(after, len(path)):
        path.replace(index, correction @ path.pose(index))
    if is_near(correction, *CARRIED_BY_DEPTH) or before < 1:
        twist = se3_log(correction)
        for index in range(before + 1, after):
            share = (index - before) / (after - before)
            path.replace(index, se3_exp(share * twist) @ path.pose(index))
        return
    start, n = path.pose(before), after - before
    across = se3_log(inverse(start) @ path.pose(after))
    start_velocity = n * se3_log(inverse(path.pose(before - 1)) @ start)
    end_velocity = n * se3_log(inverse(path.pose(after)) @ path.pose(after + 1))
    for index in range(before + 1, after):
        u = (index - before) / n
        twist = (
            u * (1 - u) ** 2 * start_velocity + u**2 * (3 - 2 * u) * across - u**2 * (1 - u) * end_velocity
        )
        path.replace(index, start @ se3_exp(twist))
