"""Events of a pixel with the faults of real ones, between two frames of log brightness (v2e, Hu et al. 2021).

Between frames at t0 and t1 the log brightness L of a pixel is a straight line. The photoreceptor follows it
as a low pass of first order whose bandwidth is in proportion to brightness b,

    dx/dt = (L - x) / tau,   tau = 1 / (2 pi bandwidth max(b, DARK)).

The solution for a ramp is known, so x is exact at the ends of substeps; in between it is a straight line.
An event is fired when x has moved by a threshold away from the pixel's reference r,

    x - r >= C+   or   x - r <= -C-,

where leak lowers r by `leak` C+ a second. Noise events come at random times (Poisson) at a rate that falls
from `noise` in the dark to a quarter of it at brightness 1 (v2e); hot pixels fire at one rate always. After
an event of any cause the pixel is blind for the dead time; then r = x. What changed meanwhile is lost.

Random numbers are hashed from (seed, pixel, count). Times are whole nanoseconds. Two passes, count and fill.
"""

import math
from dataclasses import dataclass

import numpy as np

from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.event_simulation import (
    MIN_THRESHOLD,
    EventArrays,
    check_frames,
    in_two_passes,
)
from edslam_ti.kernels.hashing import hashed_normal, hashed_uniform
from edslam_ti.kernels.runtime import check_shape

LONGEST_SUBSTEP = 500_000  # nanoseconds, where bandwidth is limited
DARK = 20 / 275  # brightness below which bandwidth falls no further (v2e)
BRIGHT_SHARE = 0.25  # of the shot noise in the dark that is left at brightness 1 (v2e)


@dataclass(frozen=True)
class PixelTraits:
    """What tells pixels from each other, and stays as it is."""

    positive: np.ndarray  # [H, W] float64, C+
    negative: np.ndarray  # [H, W] float64, C-
    leak: np.ndarray  # [H, W] float64, Hz
    noise: np.ndarray  # [H, W] float64, Hz, of noise events in the dark
    is_hot: np.ndarray  # [H, W] int32, 1: noise comes at that rate always


@dataclass(frozen=True)
class PixelState:
    """State of every pixel; `sensed_events` advances it in place."""

    filtered: np.ndarray  # [H, W] float64, log brightness behind the low pass
    reference: np.ndarray  # [H, W] float64
    blind_until: np.ndarray  # [H, W] int64 ns; -1: not blind
    next_noise: np.ndarray  # [H, W] int64 ns, of the next candidate
    num_noise: np.ndarray  # [H, W] int32, candidates drawn so far
    num_events: np.ndarray  # [H, W] int32


@ti.kernel
def _sense(
    log_start: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [H, W]
    log_end: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [H, W]
    start: ti.i64,
    end: ti.i64,
    substeps: ti.i32,
    epsilon: ti.f64,
    bandwidth: ti.f64,
    jitter: ti.f64,
    dead: ti.i64,
    seed: ti.u32,
    fill: ti.i32,  # 0: count only; 1: write events and advance the state
    positive: ti.types.ndarray(dtype=ti.f64, ndim=2),  # [H, W]
    negative: ti.types.ndarray(dtype=ti.f64, ndim=2),  # [H, W]
    leak: ti.types.ndarray(dtype=ti.f64, ndim=2),  # [H, W]
    noise: ti.types.ndarray(dtype=ti.f64, ndim=2),  # [H, W]
    is_hot: ti.types.ndarray(dtype=ti.i32, ndim=2),  # [H, W]
    filtered: ti.types.ndarray(dtype=ti.f64, ndim=2),  # [H, W]
    reference: ti.types.ndarray(dtype=ti.f64, ndim=2),  # [H, W]
    blind_until: ti.types.ndarray(dtype=ti.i64, ndim=2),  # [H, W]
    next_noise: ti.types.ndarray(dtype=ti.i64, ndim=2),  # [H, W]
    num_noise: ti.types.ndarray(dtype=ti.i32, ndim=2),  # [H, W]
    num_events: ti.types.ndarray(dtype=ti.i32, ndim=2),  # [H, W]
    counts: ti.types.ndarray(dtype=ti.i32, ndim=2),  # out [H, W] when counting
    offsets: ti.types.ndarray(dtype=ti.i64, ndim=2),  # [H, W] first slot of each pixel when filling
    t: ti.types.ndarray(dtype=ti.i64, ndim=1),  # out [N]
    x: ti.types.ndarray(dtype=ti.i16, ndim=1),  # out [N]
    y: ti.types.ndarray(dtype=ti.i16, ndim=1),  # out [N]
    polarity: ti.types.ndarray(dtype=ti.i8, ndim=1),  # out [N]
):
    for row, column in ti.ndrange(log_start.shape[0], log_start.shape[1]):
        pixel = ti.cast(row * log_start.shape[1] + column, ti.u32)
        L0 = ti.cast(log_start[row, column], ti.f64)
        L1 = ti.cast(log_end[row, column], ti.f64)
        value, level = filtered[row, column], reference[row, column]
        blind, candidate = blind_until[row, column], next_noise[row, column]
        drawn, fired = num_noise[row, column], num_events[row, column]
        slot = offsets[row, column]
        before = fired
        h = ti.cast(end - start, ti.f64) / ti.cast(substeps, ti.f64)
        brightness = ti.math.clamp(ti.exp(0.5 * (L0 + L1)) - epsilon, ti.f64(0.0), ti.f64(1.0))
        tau, decay = ti.f64(0.0), ti.f64(0.0)
        if bandwidth > 0:
            tau = ti.f64(1e9 / (2 * math.pi)) / (bandwidth * ti.max(brightness, ti.f64(DARK)))
            decay = ti.exp(-h / tau)
        step = (L1 - L0) / ti.cast(substeps, ti.f64)
        falling = leak[row, column] * positive[row, column] * ti.f64(1e-9)  # of the reference, per ns
        accepted = ti.f64(1.0) - ti.f64(1 - BRIGHT_SHARE) * brightness
        if is_hot[row, column] == 1:
            accepted = ti.f64(1.0)
        for s in range(substeps):
            begin = h * ti.cast(s, ti.f64)  # ns since `start`, as all times below
            finish = begin + h
            first = value
            last = L0 + step * ti.cast(s + 1, ti.f64)
            if bandwidth > 0:  # x = L - lag + (x0 - L0 + lag) exp(-t / tau) for L of slope lag / tau
                lag = step / h * tau
                last += -lag + (first - (L0 + step * ti.cast(s, ti.f64)) + lag) * decay
            slope = (last - first) / h
            now = begin
            going = True
            while going:
                if blind >= 0:
                    awake = ti.max(ti.cast(blind - start, ti.f64), now)
                    if awake >= finish:
                        going = False
                    else:
                        now = awake
                        level = first + slope * (now - begin)
                        blind = ti.i64(-1)
                if going:
                    high, low = positive[row, column], negative[row, column]
                    if jitter > 0:
                        factor = 1 + jitter * hashed_normal(seed, pixel, ti.cast(fired, ti.u32))
                        high = ti.max(ti.f64(MIN_THRESHOLD), high * factor)
                        low = ti.max(ti.f64(MIN_THRESHOLD), low * factor)
                    apart = first + slope * (now - begin) - level
                    rate = slope + falling
                    p = 0
                    time = finish
                    if apart >= high:
                        p, time = 1, now
                    elif apart <= -low:
                        p, time = -1, now
                    elif rate > 0 and apart + rate * (finish - now) >= high:
                        p, time = 1, ti.min(now + (high - apart) / rate, finish)
                    elif rate < 0 and apart + rate * (finish - now) <= -low:
                        p, time = -1, ti.min(now + (-low - apart) / rate, finish)
                    next_time = ti.cast(candidate - start, ti.f64)
                    if next_time <= time:  # a candidate for a noise event comes before the crossing
                        chance = hashed_uniform(seed + ti.u32(1), pixel, ti.cast(drawn, ti.u32))
                        wait = -ti.log(hashed_uniform(seed + ti.u32(2), pixel, ti.cast(drawn, ti.u32)))
                        candidate += 1 + ti.cast(wait * 1e9 / noise[row, column], ti.i64)
                        drawn += 1
                        p = 0
                        if next_time >= now and chance < accepted:  # earlier ones fell into the dead time
                            p = 1 if chance < 0.5 * accepted else -1
                            time = next_time
                    elif p == 0:
                        level -= falling * (finish - now)
                        going = False
                    if p != 0:
                        stamp = start + ti.cast(time + 0.5, ti.i64)
                        if fill == 1:
                            t[slot] = stamp
                            x[slot] = ti.cast(column, ti.i16)
                            y[slot] = ti.cast(row, ti.i16)
                            polarity[slot] = ti.cast(p, ti.i8)
                            slot += 1
                        fired += 1
                        now = time
                        level = first + slope * (now - begin)
                        if dead > 0:
                            blind = stamp + dead
            value = last
        if fill == 1:
            filtered[row, column], reference[row, column] = value, level
            blind_until[row, column], next_noise[row, column] = blind, candidate
            num_noise[row, column], num_events[row, column] = drawn, fired
        else:
            counts[row, column] = fired - before


def sensed_events(
    log_start: np.ndarray,  # [H, W] float32, log brightness at `start`
    log_end: np.ndarray,  # [H, W] float32, log brightness at `end`
    start: int,  # nanoseconds
    end: int,  # nanoseconds
    traits: PixelTraits,
    state: PixelState,  # changed
    epsilon: float,  # added to brightness before the logarithm
    bandwidth: float,  # Hz at brightness 1; 0: unlimited
    jitter: float,  # standard deviation of a threshold from event to event, relative
    dead_time: int,  # nanoseconds
    seed: int = 0,
) -> EventArrays:
    """Return the events fired in (start, end] and advance the pixels' state."""
    check_frames(log_start, log_end, start, end)
    check_shape("state.reference", state.reference, log_start.shape)
    check_shape("traits.positive", traits.positive, log_start.shape)
    substeps = -(-(end - start) // LONGEST_SUBSTEP) if bandwidth > 0 else 1
    fixed = (
        log_start,
        log_end,
        start,
        end,
        substeps,
        epsilon,
        bandwidth,
        jitter,
        dead_time,
        seed & 0xFFFFFFFF,
    )
    pixels = (traits.positive, traits.negative, traits.leak, traits.noise, traits.is_hot)
    memory = (
        *(state.filtered, state.reference, state.blind_until),
        *(state.next_noise, state.num_noise, state.num_events),
    )

    def run(fill: int, *outputs: np.ndarray) -> None:
        _sense(*fixed, fill, *pixels, *memory, *outputs)

    return in_two_passes(run, log_start.shape, start, end)
