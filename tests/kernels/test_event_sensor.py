"""Events of pixels with faults: kernel against a plain twin, and the statistics that each fault must show."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edslam_ti.kernels.event_sensor import BRIGHT_SHARE, DARK, PixelState, PixelTraits, sensed_events
from edslam_ti.kernels.event_simulation import EventArrays

MILLISECOND = 1_000_000  # nanoseconds
SECOND = 1000 * MILLISECOND
EPSILON = 1 / 255
STEP = 2000  # nanoseconds, of the twin


def traits(shape: tuple[int, int], **rates: float) -> PixelTraits:
    """Return pixels that are all alike."""
    values = {"positive": 0.2, "negative": 0.15, "leak": 0.0, "noise": 0.0} | rates
    arrays = {name: np.full(shape, value) for name, value in values.items()}
    return PixelTraits(**arrays, is_hot=np.zeros(shape, np.int32))


def state(log_first: np.ndarray, noise: float = 0.0) -> PixelState:
    waits = np.random.default_rng(1).exponential(1, log_first.shape)
    first = np.full(log_first.shape, 2**62) if noise == 0 else (waits * SECOND / noise).astype(np.int64)
    return PixelState(
        log_first.astype(np.float64), log_first.astype(np.float64),
        np.full(log_first.shape, -1, np.int64), first,
        np.zeros(log_first.shape, np.int32), np.zeros(log_first.shape, np.int32),
    )  # fmt: skip


def sensed(frames: list[np.ndarray], times: list[int], pixels: PixelTraits, **faults: Any) -> EventArrays:
    """Return all events of a few frames."""
    settings = {"epsilon": EPSILON, "bandwidth": 0.0, "jitter": 0.0, "dead_time": 0, "seed": 3} | faults
    memory = state(frames[0], float(pixels.noise.max()))
    parts = [
        sensed_events(a, b, start, end, pixels, memory, **settings)
        for (a, b), (start, end) in zip(itertools.pairwise(frames), itertools.pairwise(times))
    ]
    return EventArrays(*(np.concatenate([getattr(p, n) for p in parts]) for n in ("x", "y", "t", "polarity")))


def plain_pixel(
    levels: list[float], times: list[int], positive: float, negative: float, leak: float, bandwidth: float,
    dead_time: int,
) -> list[tuple[int, int]]:  # fmt: skip
    """Return (t, polarity) of one pixel, simulated in small steps of time."""
    filtered = reference = levels[0]
    blind_until, events = -1, []
    for (a, b), (start, end) in zip(itertools.pairwise(levels), itertools.pairwise(times)):
        brightness = min(max(np.exp((a + b) / 2) - EPSILON, 0), 1)
        for t in range(start, end, STEP):
            seen = a + (b - a) * (t + STEP / 2 - start) / (end - start)
            if bandwidth > 0:
                tau = 1e9 / (2 * np.pi * bandwidth * max(brightness, DARK))
                filtered += (seen - filtered) * (1 - np.exp(-STEP / tau))
            else:
                filtered = a + (b - a) * (t + STEP - start) / (end - start)
            if t + STEP < blind_until:
                continue
            if blind_until >= 0:
                reference, blind_until = filtered, -1
            reference -= leak * positive * STEP / 1e9
            p = 1 if filtered - reference >= positive else -1 if filtered - reference <= -negative else 0
            if p:
                events.append((t + STEP, p))
                reference += positive if p > 0 else -negative  # where it was crossed, not a step later
                blind_until = t + STEP + dead_time if dead_time else -1
    return events


@pytest.mark.parametrize(
    ("faults", "tolerance"),  # ns; steps of the twin, and straight lines of half a millisecond in the kernel
    [
        ({"dead_time": 700_000}, 30_000),
        ({"leak": 20.0}, 40_000),
        ({"bandwidth": 300.0}, 100_000),
        ({"bandwidth": 300.0, "dead_time": 700_000, "leak": 20.0}, 150_000),
    ],
    ids=["dead time", "leak", "bandwidth", "together"],
)
def test_kernel_equals_a_plain_loop_over_time(faults: dict[str, Any], tolerance: int) -> None:
    rng = np.random.default_rng(2)
    times = [0, 5 * MILLISECOND, 9 * MILLISECOND, 14 * MILLISECOND]
    frames = [rng.uniform(-2.5, -0.1, (2, 3)).astype(np.float32) for _ in times]
    pixels = replace(traits((2, 3)), leak=np.full((2, 3), faults.get("leak", 0.0)))
    settings = {name: value for name, value in faults.items() if name != "leak"}
    events = sensed(frames, times, pixels, **settings)
    total = 0
    for y, x in np.ndindex(2, 3):
        expected = plain_pixel(
            [float(f[y, x]) for f in frames], times, 0.2, 0.15, faults.get("leak", 0.0),
            faults.get("bandwidth", 0.0), faults.get("dead_time", 0),
        )  # fmt: skip
        mine = (events.x == x) & (events.y == y)
        assert events.polarity[mine].tolist() == [p for _, p in expected]
        assert np.abs(events.t[mine] - [t for t, _ in expected]).max(initial=0) < tolerance
        total += len(expected)
    assert total > 20


def still(brightness: float, shape: tuple[int, int], seconds: int = 4) -> tuple[list[np.ndarray], list[int]]:
    """Return frames of one brightness, a second apart."""
    frame = np.full(shape, np.log(brightness + EPSILON), np.float32)
    return [frame] * (seconds + 1), [k * SECOND for k in range(seconds + 1)]


def test_leak_fires_brighter_events_at_its_rate() -> None:
    events = sensed(*still(0.5, (10, 10)), traits((10, 10), leak=2.1))
    assert (events.polarity == 1).all()
    assert len(events.t) == 10 * 10 * 8  # at 0.476 s, 0.952 s, ... up to 4 s


@pytest.mark.parametrize(("brightness", "share"), [(0.0, 1.0), (1.0, BRIGHT_SHARE)])
def test_shot_noise_is_rarer_in_the_light_and_of_both_polarities(brightness: float, share: float) -> None:
    events = sensed(*still(brightness, (60, 80)), traits((60, 80), noise=1.5))
    expected = 60 * 80 * 4 * 1.5 * share  # Poisson: 28800 +- 170 in the dark, 7200 +- 85 at brightness 1
    assert abs(len(events.t) - expected) < 4 * np.sqrt(expected)
    assert abs((events.polarity == 1).mean() - 0.5) < 2 / np.sqrt(expected)
    gaps = np.diff(np.sort(events.t))  # of a Poisson process: exponential, mean and deviation alike
    assert abs(gaps.std() / gaps.mean() - 1) < 0.05


def test_hot_pixels_fire_in_the_light_as_in_the_dark() -> None:
    pixels = traits((6, 8), noise=100.0)
    pixels.is_hot[:] = 1
    counts = [len(sensed(*still(b, (6, 8)), pixels).t) for b in (0.0, 1.0)]
    assert counts[0] == counts[1]
    assert abs(counts[0] - 6 * 8 * 400) < 4 * np.sqrt(6 * 8 * 400)


def test_no_two_events_of_a_pixel_are_nearer_than_the_dead_time() -> None:
    rng = np.random.default_rng(4)
    times = [k * 5 * MILLISECOND for k in range(6)]
    frames = [rng.uniform(-4, -0.1, (20, 30)).astype(np.float32) for _ in times]
    events = sensed(frames, times, traits((20, 30), noise=200.0), dead_time=MILLISECOND)
    pixel = events.y.astype(int) * 30 + events.x
    order = np.lexsort((events.t, pixel))
    gaps = np.diff(events.t[order])[np.diff(pixel[order]) == 0]
    assert len(gaps) > 5000
    assert MILLISECOND <= gaps.min() < 1.05 * MILLISECOND


def test_change_during_the_dead_time_is_lost() -> None:
    # Brightness rises by 1 in 10 ms: 0.2 take 2 ms, and 1 ms is lost after each event: at 2, 5, 8 ms.
    frames = [np.zeros((1, 1), np.float32), np.ones((1, 1), np.float32)]
    events = sensed(frames, [0, 10 * MILLISECOND], traits((1, 1)), dead_time=MILLISECOND)
    np.testing.assert_allclose(events.t, np.array([2, 5, 8]) * MILLISECOND, atol=2)


def test_low_pass_delays_dark_pixels_more() -> None:
    # A step of log brightness within 10 us: the event comes after tau ln(1 / (1 - 0.2 / 0.5)).
    for brightness in (0.9, 0.3):
        low = np.log(brightness + EPSILON)
        frames = [np.full((1, 1), v, np.float32) for v in (low, low + 0.5, low + 0.5)]
        events = sensed(frames, [0, 10_000, 20 * MILLISECOND], traits((1, 1)), bandwidth=100.0)
        tau = 1e9 / (2 * np.pi * 100.0 * min(np.exp(low + 0.5) - EPSILON, 1))
        assert abs(events.t[0] - tau * np.log(1 / 0.6)) < 0.12 * tau  # lines of 0.5 ms


def test_thresholds_differ_from_event_to_event_by_the_jitter() -> None:
    shape = (60, 80)
    frames = [np.zeros(shape, np.float32), np.full(shape, 0.3, np.float32)]
    events = sensed(frames, [0, 300 * MILLISECOND], traits(shape), jitter=0.1)
    first = np.full(shape, 2**62)
    np.minimum.at(first, (events.y, events.x), events.t)
    thresholds = first / SECOND
    assert abs(thresholds.mean() - 0.2) < 0.001
    assert abs(thresholds.std() - 0.02) < 0.001  # 4800 samples: +- 0.0002
