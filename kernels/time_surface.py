"""Time surface (Eq. 1) and accumulated polarity (Eq. 11) of an event stream.

T(x, t) = exp(-(t - t_last(x)) / tau),    E(x) = C+ n+(x) - C- n-(x), n the events at x of either polarity
"""

import functools

import numpy as np

from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.runtime import CHUNK, check_shape, workers

MANY_EVENTS = 500_000  # with fewer, numpy finishes before a second core has woken up
ROUNDS = 4  # at most this many, from the newest events backwards, until every pixel has had one
ROUND = 8  # at least this many events per pixel in one of several rounds
PACKED = 4  # int16 in a 64-bit word
EVEN = 0x0000FFFF0000FFFF  # bits of the first and third int16


@ti.kernel
def _newest_events(
    x: ti.types.ndarray(ti.i64, ndim=1),  # [N / 4] four int16 each, none negative
    y: ti.types.ndarray(ti.i64, ndim=1),  # [N / 4]
    polarity: ti.types.ndarray(ti.i8, ndim=1),  # [N], any if not by polarity
    first: ti.i32,  # word
    last: ti.i32,  # word after those to look at
    height: ti.i32,
    width: ti.i32,
    num_workers: ti.i32,
    newest: ti.types.ndarray(ti.i32, ndim=1),  # out [workers * pixels] index of an event, -1 in
    by_polarity: ti.template(),
):
    # Parallel stores to one image would race, and atomics are slow. So each worker has a part of the time and
    # an image of its own. It holds indices, which are half as long as times and need not be read.
    num_pixels, words = newest.shape[0] // num_workers, ti.cast(last - first, ti.i64)
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w = chunk // CHUNK
            own = w * num_pixels
            begin, end = words * w // num_workers, words * (w + 1) // num_workers
            for word in range(first + ti.cast(begin, ti.i32), first + ti.cast(end, ti.i32)):
                # Two pixels, y * width + x, in one product: each half of the number is one of them.
                even = (y[word] & ti.i64(EVEN)) * width + (x[word] & ti.i64(EVEN))
                odd = (y[word] >> 16 & ti.i64(EVEN)) * width + (x[word] >> 16 & ti.i64(EVEN))
                pixels = [even, odd, even >> 32, odd >> 32]
                for k in ti.static(range(PACKED)):
                    i = word * PACKED + k
                    pixel = own + ti.cast(pixels[k], ti.i32)
                    if ti.static(by_polarity):
                        pixel += ti.select(polarity[i] > 0, height * width, 0)
                    newest[pixel] = i


@ti.kernel
def _count_events(
    x: ti.types.ndarray(ti.i16, ndim=1),  # [N]
    y: ti.types.ndarray(ti.i16, ndim=1),  # [N]
    polarity: ti.types.ndarray(ti.i8, ndim=1),  # [N]
    width: ti.i32,
    counts: ti.types.ndarray(ti.i32, ndim=1),  # in and out [H W 2]
    last: ti.types.ndarray(ti.i8, ndim=1),  # in and out [H W]
):
    ti.loop_config(serialize=True)  # the last event wins
    for i in range(x.shape[0]):
        pixel = ti.cast(y[i], ti.i32) * width + ti.cast(x[i], ti.i32)
        # A branch on the polarity would often be mispredicted.
        is_positive = ti.cast(polarity[i], ti.i32) + 1 >> 1
        counts[2 * pixel + is_positive] = counts[2 * pixel + is_positive] + 1
        last[pixel] = polarity[i]


def update_last_timestamps(
    x: np.ndarray,  # [N] int16
    y: np.ndarray,  # [N] int16
    t: np.ndarray,  # [N] float64 seconds, sorted, not before any entry of `last`
    last: np.ndarray,  # [H, W] float64 seconds, or [2, H, W] by polarity (-1, +1); changed in place
    polarity: np.ndarray | None = None,  # [N] int8, -1 or +1; needed by polarity only
) -> None:
    """Write the time of each pixel's newest event into `last`; start it with -inf."""
    check_shape("y", y, x.shape)
    check_shape("t", t, x.shape)
    if last.ndim not in (2, 3) or (last.ndim == 3) != (polarity is not None):
        raise ValueError(
            f"last: expected shape (H, W), or (2, H, W) with polarities, got {last.shape} "
            f"{'without' if polarity is None else 'with'} polarities"
        )
    if polarity is not None:
        check_shape("polarity", polarity, x.shape)
        check_shape("last", last, (2, None, None))
    if len(x) == 0:
        return
    if not last.flags.c_contiguous:
        raise ValueError("last: expected a contiguous array; pass a copy and assign it back")
    height, width = last.shape[-2:]
    _check_inside(x, y, (height, width))
    flat = last.reshape(-1)
    if len(x) < MANY_EVENTS:
        pixels = np.multiply(y, width, dtype=np.intp)
        pixels += x
        if polarity is not None:
            pixels += (polarity > 0) * (height * width)
        flat[pixels] = t  # of several events at a pixel numpy keeps the last
        return
    words = len(x) // PACKED
    packed = [np.ascontiguousarray(array[: words * PACKED]).view(np.int64) for array in (x, y)]
    signs = np.empty(0, np.int8) if polarity is None else polarity
    event = _newest(packed, signs, (height, width), flat.size)
    np.copyto(flat, t.take(event, mode="clip"), where=event >= 0)
    if rest := len(x) % PACKED:
        update_last_timestamps(
            x[-rest:], y[-rest:], t[-rest:], last, None if polarity is None else polarity[-rest:]
        )


def _newest(
    packed: list[np.ndarray],  # x and y, [N / 4] int64
    polarity: np.ndarray,  # [N] int8, or [0] if polarities do not matter
    shape: tuple[int, int],  # (H, W)
    num_pixels: int,  # H W, twice that by polarity
) -> np.ndarray:  # [pixels] int32
    """Return the index of each pixel's newest event, -1 where there was none."""
    newest, event = _memory(workers(), num_pixels)
    event.fill(-1)
    words = len(packed[0])
    rounds = min(max(words * PACKED // (ROUND * num_pixels), 1), ROUNDS)
    for k in reversed(range(rounds)):
        newest.fill(-1)
        part = words * k // rounds, words * (k + 1) // rounds
        flat = newest.reshape(-1)
        _newest_events(*packed, polarity, *part, *shape, workers(), flat, len(polarity) > 0)
        for indices in newest:  # a later event has a larger index
            np.maximum(event, indices, out=event)
        if event.min() >= 0:
            break
    return event


@functools.lru_cache(maxsize=1)
def _memory(num_workers: int, num_pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return memory that is kept, because allocating a fresh array's pages costs more than filling it."""
    return np.empty((num_workers, num_pixels), np.int32), np.empty(num_pixels, np.int32)


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


def count_events(
    x: np.ndarray,  # [N] int16
    y: np.ndarray,  # [N] int16
    polarity: np.ndarray,  # [N] int8, -1 or +1, in order of time
    counts: np.ndarray,  # [H, W, 2] int32, changed in place: negative and positive events
    last: np.ndarray,  # [H, W] int8, changed in place: polarity of the newest event
) -> None:
    """Add events to each pixel's counts of both polarities (Eq. 11), and record its newest polarity."""
    check_shape("y", y, x.shape)
    check_shape("polarity", polarity, x.shape)
    check_shape("counts", counts, (*last.shape, 2))
    if len(x):
        _check_inside(x, y, last.shape)
        _count_events(x, y, polarity, last.shape[1], counts.reshape(-1), last.reshape(-1))


def compile_kernels() -> None:
    """Compile the counting kernel, so that the first frame of a sequence does not wait for it."""
    place, one = np.zeros(1, np.int16), np.ones(1, np.int8)
    count_events(place, place, one, np.zeros((1, 1, 2), np.int32), np.zeros((1, 1), np.int8))


def _check_inside(x: np.ndarray, y: np.ndarray, shape: tuple[int, ...]) -> None:
    """Check that all events are inside the image, because kernels do not check bounds."""
    height, width = shape
    # Negative numbers are large as unsigned ones, so one comparison checks both bounds.
    if x.view(np.uint16).max() >= width or y.view(np.uint16).max() >= height:
        raise ValueError(
            f"events: expected 0 <= x < {width} and 0 <= y < {height}, got x {x.min()} to {x.max()}, "
            f"y {y.min()} to {y.max()}"
        )
