"""Events of an ideal event camera between two frames of log intensity (ESIM, Rebecq et al., CoRL 2018).

Between frames at t0 and t1 the log intensity L of a pixel is a straight line. An event is fired each
time L has moved by the contrast threshold away from the pixel's reference level, which then moves to
the level crossed:

    level = reference + p C_k,   t = t0 + (t1 - t0) (level - L0) / (L1 - L0),   p = sign(L1 - L0),

where C_k = max(MIN_THRESHOLD, C + sigma g_k) is the pixel's k-th threshold and g_k a standard normal
number hashed from (seed, pixel, k): results do not depend on the order of execution. Within the
refractory period of the last event the crossing moves the reference but fires nothing.

Times are whole nanoseconds. Two passes, count and fill, need no atomics; events come sorted by time,
then by pixel.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.hashing import hashed_normal
from edslam_ti.kernels.runtime import check_shape

MIN_THRESHOLD = 0.01  # ESIM's lower bound of a noisy threshold
NEVER = -(2**62)  # time of the last event of a pixel that has fired none


@dataclass(frozen=True)
class EventSensorState:
    """State of every pixel; `simulate_events` advances it in place."""

    reference: np.ndarray  # [H, W] float64, log intensity at the last crossing
    num_crossings: np.ndarray  # [H, W] int32, crossings so far (k above)
    last_event: np.ndarray  # [H, W] int64, nanoseconds

    @staticmethod
    def start(log_intensity: np.ndarray) -> "EventSensorState":  # [H, W]
        """Return the state of a sensor that has adapted to a first frame."""
        shape = log_intensity.shape
        return EventSensorState(
            np.array(log_intensity, np.float64), np.zeros(shape, np.int32), np.full(shape, NEVER, np.int64)
        )


@dataclass(frozen=True)
class EventArrays:
    """Events as parallel arrays, sorted by time."""

    x: np.ndarray  # [N] int16, column
    y: np.ndarray  # [N] int16, row
    t: np.ndarray  # [N] int64, nanoseconds
    polarity: np.ndarray  # [N] int8, -1 or +1


@ti.kernel
def _cross_thresholds(
    log_start: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [H, W]
    log_end: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [H, W]
    start: ti.i64,
    end: ti.i64,
    positive: ti.f64,
    negative: ti.f64,
    sigma: ti.f64,
    refractory: ti.i64,
    seed: ti.u32,
    fill: ti.i32,  # 0: count only; 1: write events and advance the state
    reference: ti.types.ndarray(dtype=ti.f64, ndim=2),  # [H, W]
    num_crossings: ti.types.ndarray(dtype=ti.i32, ndim=2),  # [H, W]
    last_event: ti.types.ndarray(dtype=ti.i64, ndim=2),  # [H, W]
    counts: ti.types.ndarray(dtype=ti.i32, ndim=2),  # out [H, W] when counting
    offsets: ti.types.ndarray(dtype=ti.i64, ndim=2),  # [H, W] first slot of each pixel when filling
    t: ti.types.ndarray(dtype=ti.i64, ndim=1),  # out [N]
    x: ti.types.ndarray(dtype=ti.i16, ndim=1),  # out [N]
    y: ti.types.ndarray(dtype=ti.i16, ndim=1),  # out [N]
    polarity: ti.types.ndarray(dtype=ti.i8, ndim=1),  # out [N]
):
    for row, column in ti.ndrange(log_start.shape[0], log_start.shape[1]):
        L0 = ti.cast(log_start[row, column], ti.f64)
        L1 = ti.cast(log_end[row, column], ti.f64)
        level = reference[row, column]
        k = num_crossings[row, column]
        last = last_event[row, column]
        slot = offsets[row, column]
        fired = 0
        if L1 != L0:
            p = ti.f64(1.0)
            base = positive
            if L1 < L0:
                p = ti.f64(-1.0)
                base = negative
            crossing = True
            while crossing:
                threshold = base
                if sigma > 0:
                    noise = hashed_normal(
                        seed, ti.cast(row * log_start.shape[1] + column, ti.u32), ti.cast(k, ti.u32)
                    )
                    threshold = ti.max(ti.f64(MIN_THRESHOLD), base + sigma * noise)
                following = level + p * threshold
                if (L1 - following) * p >= 0:
                    fraction = ti.math.clamp((following - L0) / (L1 - L0), ti.f64(0.0), ti.f64(1.0))
                    time = start + ti.cast(ti.cast(end - start, ti.f64) * fraction + ti.f64(0.5), ti.i64)
                    level = following
                    k += 1
                    if time - last >= refractory:
                        last = time
                        if fill == 1:
                            t[slot] = time
                            x[slot] = ti.cast(column, ti.i16)
                            y[slot] = ti.cast(row, ti.i16)
                            polarity[slot] = ti.cast(p, ti.i8)
                            slot += 1
                        fired += 1
                else:
                    crossing = False
        if fill == 1:
            reference[row, column] = level
            num_crossings[row, column] = k
            last_event[row, column] = last
        else:
            counts[row, column] = fired


def simulate_events(
    log_start: np.ndarray,  # [H, W] float32, log intensity at `start`
    log_end: np.ndarray,  # [H, W] float32, log intensity at `end`
    start: int,  # nanoseconds
    end: int,  # nanoseconds
    state: EventSensorState,  # changed
    positive_threshold: float,  # C of brighter events
    negative_threshold: float,  # C of darker events
    threshold_noise: float = 0.0,  # sigma of each threshold
    refractory_period: int = 0,  # nanoseconds
    seed: int = 0,
) -> EventArrays:
    """Return the events fired in (start, end] and advance the sensor's state."""
    check_frames(log_start, log_end, start, end)
    check_shape("state.reference", state.reference, log_start.shape)
    if min(positive_threshold, negative_threshold) < MIN_THRESHOLD:
        raise ValueError(
            f"contrast threshold: expected at least {MIN_THRESHOLD}, got "
            f"{positive_threshold} and {negative_threshold}"
        )
    if threshold_noise < 0 or refractory_period < 0:
        raise ValueError("threshold noise and refractory period: expected values of at least 0")
    thresholds = (positive_threshold, negative_threshold, threshold_noise)
    memory = (state.reference, state.num_crossings, state.last_event)
    fixed = (log_start, log_end, start, end, *thresholds, refractory_period, seed & 0xFFFFFFFF)

    def run(fill: int, *outputs: np.ndarray) -> None:
        _cross_thresholds(*fixed, fill, *memory, *outputs)

    return in_two_passes(run, log_start.shape, start, end)


def check_frames(log_start: np.ndarray, log_end: np.ndarray, start: int, end: int) -> None:
    """Raise ValueError unless there are two images [H, W] float32 of one size, and time between them."""
    check_shape("log_start", log_start, (None, None))
    check_shape("log_end", log_end, log_start.shape)
    if log_start.dtype != np.float32 or log_end.dtype != np.float32:
        raise ValueError(f"log intensity: expected float32, got {log_start.dtype} and {log_end.dtype}")
    if end <= start:
        raise ValueError(f"frame times: expected start < end, got {start} and {end} ns")


def in_two_passes(
    run: Callable[..., None],  # of fill, counts [H, W], offsets [H, W], t [N], x [N], y [N], polarity [N]
    shape: tuple[int, ...],  # (H, W)
    start: int,  # nanoseconds
    end: int,
) -> EventArrays:
    """Let a kernel count every pixel's events (fill 0), then write them (fill 1); return them by time."""
    counts = np.empty(shape, np.int32)

    def launch(fill: int, offsets: np.ndarray, total: int) -> tuple[np.ndarray, ...]:
        size = max(total, 1)  # Taichi takes no empty arrays
        t, polarity = np.empty(size, np.int64), np.empty(size, np.int8)
        x, y = np.empty(size, np.int16), np.empty(size, np.int16)
        run(fill, counts, offsets, t, x, y, polarity)
        return t[:total], x[:total], y[:total], polarity[:total]

    launch(0, np.zeros(shape, np.int64), 0)
    ends = np.cumsum(counts, dtype=np.int64).reshape(shape)
    times, x, y, polarity = launch(1, ends - counts, int(ends[-1, -1]))
    order = order_in_time(times, start, end)
    return EventArrays(x[order], y[order], times[order], polarity[order])


def order_in_time(
    t: np.ndarray,  # [N] int64 ns, within [start, end]
    start: int,
    end: int,
) -> np.ndarray:  # [N] int64
    """Return the stable order of times.

    With time and slot in one 64-bit key, an unstable sort of keys sorts times stably, ten times faster.
    """
    slot_bits = max(len(t).bit_length(), 1)
    if (end - start).bit_length() + slot_bits > 63:
        return np.argsort(t, kind="stable")
    keys = ((t - start) << slot_bits) | np.arange(len(t))
    keys.sort()
    order: np.ndarray = keys & ((1 << slot_bits) - 1)
    return order
