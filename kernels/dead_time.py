"""Change that pixels have missed while they were blind after an event (dead time, refractory period).

After an event a pixel is blind for the dead time D, and then compares with the brightness of that moment. Of
the interval d between two events of one polarity, the pixel has seen d - D, in which brightness has changed
by one threshold. At the same rate it has changed by D / (d - D) thresholds while the pixel was blind. Where
the rate falls, as after the last event of an edge, it has fallen during that dead time: half of what it was
counts.
"""

import numpy as np

from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.runtime import check_shape

# Shortest time of sight, as a share of the dead time: an event counts as at most 1 + 1 / SHORTEST_SIGHT.
SHORTEST_SIGHT = 0.2
FALLING = 0.5  # share of a fall of the rate that is added for the dead time before


@ti.kernel
def _add_missed(
    x: ti.types.ndarray(ti.i16, ndim=1),  # [N]
    y: ti.types.ndarray(ti.i16, ndim=1),  # [N]
    t: ti.types.ndarray(ti.f64, ndim=1),  # [N]
    polarity: ti.types.ndarray(ti.i8, ndim=1),  # [N]
    width: ti.i32,
    dead_time: ti.f64,
    last: ti.types.ndarray(ti.f64, ndim=1),  # in and out [H W]
    last_polarity: ti.types.ndarray(ti.i8, ndim=1),  # in and out [H W]
    rate: ti.types.ndarray(ti.f32, ndim=1),  # in and out [H W]
    missed: ti.types.ndarray(ti.f32, ndim=1),  # in and out [H W 2]
):
    ti.loop_config(serialize=True)  # in order of time
    for i in range(x.shape[0]):
        pixel = ti.cast(y[i], ti.i32) * width + ti.cast(x[i], ti.i32)
        before = last_polarity[pixel]
        now = 0.0
        if before == polarity[i]:
            now = ti.cast(
                dead_time / ti.max(t[i] - last[pixel] - dead_time, SHORTEST_SIGHT * dead_time), float
            )
            at = 2 * pixel + (ti.cast(polarity[i], ti.i32) + 1 >> 1)
            missed[at] = missed[at] + now
        at = 2 * pixel + (ti.cast(before, ti.i32) + 1 >> 1)
        missed[at] = missed[at] + FALLING * ti.max(rate[pixel] - now, 0.0)
        last[pixel], last_polarity[pixel], rate[pixel] = t[i], polarity[i], now


def add_missed_change(
    x: np.ndarray,  # [N] int16, inside the image
    y: np.ndarray,  # [N] int16
    t: np.ndarray,  # [N] float64 seconds, in order, not before any entry of `last`
    polarity: np.ndarray,  # [N] int8, -1 or +1
    dead_time: float,  # D, seconds
    last: np.ndarray,  # [H, W] float64 seconds, changed: time of the last event, -inf where none came
    last_polarity: np.ndarray,  # [H, W] int8, changed: its polarity, 0 where none came
    rate: np.ndarray,  # [H, W] float32, changed: thresholds missed before that event
    missed: np.ndarray,  # [H, W, 2] float32 thresholds, changed: of negative and positive changes
) -> None:
    """Add the change that pixels have missed between the events of one polarity."""
    check_shape("y", y, x.shape)
    check_shape("last_polarity", last_polarity, last.shape)
    check_shape("rate", rate, last.shape)
    check_shape("missed", missed, (*last.shape, 2))
    if len(x):
        _add_missed(
            x, y, t, polarity, last.shape[1], dead_time,
            last.reshape(-1), last_polarity.reshape(-1), rate.reshape(-1), missed.reshape(-1),
        )  # fmt: skip
