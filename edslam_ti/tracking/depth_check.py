"""Depth images that contradict events and their neighbours: files swapped, or of another time.

Brightness alone, and brightness together with depth, give a frame two poses. Where depth is that of the
frame they agree: between them what is in view moves by a few hundredths of a pixel (simulated rooms), by
tenths with a sensor's noise. Depth of another time pulls the second pose to where it was taken, away from
the first, and the image then fits worse. Faults of all frames (clocks, focal length) make differences usual:
consistency.py is for them.
"""

import itertools
import math
from collections import deque

import numpy as np

from edslam_ti.camera import NEAREST, Camera

# A frame's depth contradicts where both poses are so far apart, and the image fits worse with depth,
SMALLEST_FLOW = 0.6  # px of brightness images, at least
TIMES_USUAL = 5.0  # and so many times what is usual,
WORSE = 1.1  # and the misfit of brightness with depth is so many times that without,
FAR_FLOW, FAR_TIMES_USUAL = 1.2, 20.0  # or merely not smaller, if the poses are as far apart as that.
# A smaller misfit (median, log brightness) is that of pixels where nothing changes: few pixels have texture,
# and brightness alone does not determine a pose that depth could be measured by.
SMALLEST_MISFIT = 0.01

UNUSUAL = 1.15  # times the usual misfit, from which on a frame is looked at
FITS = 1.6  # times the usual misfit: up to there brightness alone may stand for a frame lost with depth
MOST_IN_A_ROW = 4  # frames left out; from then on brightness is in doubt as well
REMEMBERED = 20  # frames

# Depth of another scale: the median |log| ratio of depths at the same points, seen from two poses.
OTHER_SCALE = 0.25  # at least, to all frames that agree,
SAME_SCALE = 0.08  # which differ from one another by less
MIN_COMMON = 0.02  # share of the pixels that both frames must measure
COMPARED = 4000  # pixels of a frame, about

MOST_SETS = 21  # of frames that are tried; beyond, one frame after the other


def is_contradiction(flow: float, usual: float, misfit: float, misfit_without: float) -> bool:
    """Return whether depth is of another time, by the flow between both poses and by both misfits."""
    if misfit < SMALLEST_MISFIT:
        return False
    if flow > max(FAR_FLOW, FAR_TIMES_USUAL * usual):
        return misfit > misfit_without
    return flow > max(SMALLEST_FLOW, TIMES_USUAL * usual) and misfit > WORSE * misfit_without


def sets_to_try(frames: list[int], number: int, left_out: frozenset[int]) -> list[frozenset[int]]:
    """Return sets of so many frames to leave out: all, or where they are too many, those with `left_out`."""
    if math.comb(len(frames), number) <= MOST_SETS:
        return [frozenset(chosen) for chosen in itertools.combinations(frames, number)]
    return [left_out | {k} for k in frames if k not in left_out]


def log_ratio(
    depth: np.ndarray,  # [h, w] metres, 0 = missing
    other: np.ndarray,  # [h, w] of another frame
    T_other_camera: np.ndarray,  # [4, 4]
    camera: Camera,
) -> float:
    """Return the median |log| of a frame's depth, moved to another frame, over that measured there.

    It is NaN where hardly any pixel is measured in both.
    """
    step = max(1, int(np.sqrt(depth.size / COMPARED)))
    v, u = np.mgrid[0 : depth.shape[0] : step, 0 : depth.shape[1] : step]
    d = depth[v, u]
    v, u, d, number = v[d > 0], u[d > 0], d[d > 0], d.size
    points = camera.back_project_pixels(u, v, d) @ T_other_camera[:3, :3].T + T_other_camera[:3, 3]
    points = points[points[:, 2] > NEAREST]
    u, v, z = camera.project(points)
    column, row = np.rint(u), np.rint(v)
    seen = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    there = other[row[seen].astype(np.intp), column[seen].astype(np.intp)]
    measured = there > 0
    if np.count_nonzero(measured) < MIN_COMMON * number:
        return math.nan
    return float(np.median(np.abs(np.log(z[seen][measured] / there[measured]))))


def of_other_scale(ratios: np.ndarray) -> list[int]:  # [F, F] `log_ratio` of each pair
    """Return the frames whose depth differs from that of all others; none where these do not agree."""
    ratios = np.maximum(ratios, ratios.T)  # NaN stays: nothing is known of that pair
    np.fill_diagonal(ratios, 0.0)
    agrees = ratios < SAME_SCALE
    agreed = agrees[agrees.sum(1).argmax()]
    rest = ~agreed
    is_minority = 2 * np.count_nonzero(rest) < len(ratios) and len(ratios) > 2
    is_clear = agrees[np.ix_(agreed, agreed)].all() and (ratios[np.ix_(rest, agreed)] > OTHER_SCALE).all()
    return np.flatnonzero(rest).tolist() if is_minority and is_clear else []


class DepthCheck:
    """Judges the depth of one frame after the other."""

    def __init__(self) -> None:
        self._flows: deque[float] = deque(maxlen=REMEMBERED)  # px, of frames whose depth was kept
        self._left_out = 0  # in a row

    def begin(self, flows: list[float]) -> None:
        """Take what is usual in the frames that a first image is made of."""
        self._flows.clear()
        self._flows.extend(flows)
        self._left_out = 0

    def contradicts(self, flow: float, misfit: float, misfit_without: float) -> bool:
        """Return whether a frame's depth is to be left out."""
        usual = float(np.median(self._flows)) if self._flows else 0.0
        if is_contradiction(flow, usual, misfit, misfit_without) and self.may_leave_out():
            return True
        self._left_out = 0
        self._flows.append(flow)
        return False

    def may_leave_out(self) -> bool:
        """Return whether one more frame may be left out, and count it."""
        self._left_out += 1
        return self._left_out <= MOST_IN_A_ROW


def left_out(indices: list[int]) -> str:
    """Return the note about frames whose depth is left out."""
    if len(indices) == 1:
        return f"depth of frame {indices[0]} contradicts events and its neighbours: left out"
    named = ", ".join(map(str, indices[:-1])) + f" and {indices[-1]}"
    return f"depth of frames {named} contradicts events and its neighbours: left out"
