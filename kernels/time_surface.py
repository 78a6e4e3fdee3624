"""Time surface (Eq. 1) and accumulated polarity (Eq. 11) of an event stream.

T(x, t) = exp(-(t - t_last(x)) / tau),    E(x) / C = sum of p_i over the events at x in an interval
"""

import numpy as np
import taichi as ti

from kernels.runtime import CHUNK, check_shape, workers

MANY_EVENTS = 300_000  # below this numpy is done before a second core has woken up


@ti.kernel
def _newest_timestamps(
    x: ti.types.ndarray(ti.i16, ndim=1),  # [N]
    y: ti.types.ndarray(ti.i16, ndim=1),  # [N]
    t: ti.types.ndarray(ti.f64, ndim=1),  # [N] seconds, sorted
    height: ti.i32,
    width: ti.i32,
    newest: ti.types.ndarray(ti.f64, ndim=1),  # out [workers * H * W] seconds, -inf in
    num_outside: ti.types.ndarray(ti.i64, ndim=1),  # out [workers] events outside the image
):
    # Parallel stores to one image race and atomics are slow: each worker has a part of the time and an
    # image of its own.
    num_workers = num_outside.shape[0]
    n = ti.cast(x.shape[0], ti.i64)
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w = chunk // CHUNK
            first = w * height * width
            outside = ti.cast(0, ti.i64)
            for i in range(
                ti.cast(n * w // num_workers, ti.i32), ti.cast(n * (w + 1) // num_workers, ti.i32)
            ):
                row, column = ti.cast(y[i], ti.i32), ti.cast(x[i], ti.i32)
                if 0 <= row < height and 0 <= column < width:
                    newest[first + row * width + column] = t[i]
                else:
                    outside += 1
            num_outside[w] = outside


@ti.kernel
def _accumulate_polarity(
    x: ti.types.ndarray(ti.i16, ndim=1),  # [N]
    y: ti.types.ndarray(ti.i16, ndim=1),  # [N]
    polarity: ti.types.ndarray(ti.i8, ndim=1),  # [N]
    first: ti.types.ndarray(ti.i64, ndim=1),  # [B + 1] interval b holds events first[b] .. first[b + 1]
    num_workers: ti.i32,
    sums: ti.types.ndarray(ti.i16, ndim=3),  # out [B, H, W], zeros in
):
    # An interval belongs to one worker, so plain adds do not race.
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            intervals = sums.shape[0]
            w = chunk // CHUNK
            for b in range(intervals * w // num_workers, intervals * (w + 1) // num_workers):
                for i in range(ti.cast(first[b], ti.i32), ti.cast(first[b + 1], ti.i32)):
                    sums[b, y[i], x[i]] = sums[b, y[i], x[i]] + ti.cast(polarity[i], ti.i16)


def update_last_timestamps(
    x: np.ndarray,  # [N] int16
    y: np.ndarray,  # [N] int16
    t: np.ndarray,  # [N] float64 seconds, sorted
    last: np.ndarray,  # [H, W] float64 seconds, changed in place
) -> None:
    """Write the time of each pixel's newest event into `last`; start it with -inf."""
    check_shape("y", y, x.shape)
    check_shape("t", t, x.shape)
    if len(x):
        if len(x) < MANY_EVENTS:
            _check_inside(x, y, last.shape)
            last[y, x] = t  # of several events at a pixel numpy keeps the last
        else:
            newest = np.full(workers() * last.size, -np.inf)
            num_outside = np.zeros(workers(), np.int64)
            _newest_timestamps(x, y, t, *last.shape, newest, num_outside)
            if num_outside.any():
                _check_inside(x, y, last.shape)
            np.maximum(last, newest.reshape(-1, *last.shape).max(0), out=last)


def time_surface(
    last: np.ndarray,  # [H, W] float64 seconds, -inf where no event came
    t: float,  # seconds, not before any entry of `last`
    decay: float,  # tau, seconds
) -> np.ndarray:  # [H, W] float32 in [0, 1]
    """Return the time surface of Eq. 1."""
    if decay <= 0:
        raise ValueError(f"decay: expected a positive time in seconds, got {decay}")
    # numpy's exp is vectorised, Taichi's is not.
    return np.exp(((last - t) / decay).astype(np.float32))


def accumulate_polarity(
    x: np.ndarray,  # [N] int16
    y: np.ndarray,  # [N] int16
    polarity: np.ndarray,  # [N] int8, -1 or +1
    first: np.ndarray,  # [B + 1] int64 boundaries of the intervals in the event arrays
    shape: tuple[int, int],  # (H, W)
) -> np.ndarray:  # [B, H, W] int16
    """Return the sum of polarities of every pixel in every interval: E(x) / C of Eq. 11."""
    check_shape("y", y, x.shape)
    check_shape("polarity", polarity, x.shape)
    sums = np.zeros((len(first) - 1, *shape), np.int16)
    if len(x):
        _check_inside(x, y, shape)
        _accumulate_polarity(x, y, polarity, np.asarray(first, np.int64), workers(), sums)
    return sums


def _check_inside(x: np.ndarray, y: np.ndarray, shape: tuple[int, ...]) -> None:
    """Kernels do not check bounds, so this does."""
    height, width = shape
    if x.min() < 0 or y.min() < 0 or x.max() >= width or y.max() >= height:
        raise ValueError(
            f"events: expected 0 <= x < {width} and 0 <= y < {height}, got x {x.min()} to {x.max()}, "
            f"y {y.min()} to {y.max()}"
        )
