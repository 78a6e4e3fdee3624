"""Events from log intensity: kernel against its twin, and the facts an event sensor must obey."""

import itertools

import numpy as np
import pytest
import torch

from edslam_ti.kernels import reference
from edslam_ti.kernels.event_simulation import MIN_THRESHOLD, EventSensorState, simulate_events

MILLISECOND = 1_000_000  # nanoseconds


def random_frames(seed: int, count: int, shape: tuple[int, int] = (24, 40)) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.normal(0, 0.4, shape).astype(np.float32) for _ in range(count)]


@pytest.mark.parametrize(("sigma", "refractory"), [(0.0, 0), (0.03, 0), (0.03, 3 * MILLISECOND)])
def test_kernel_equals_its_twin(sigma: float, refractory: int) -> None:
    frames = random_frames(0, 4)
    state = EventSensorState.start(frames[0])
    level = torch.from_numpy(state.reference.copy())
    k = torch.from_numpy(state.num_crossings.astype(np.int64))
    last = torch.from_numpy(state.last_event.copy())
    total = 0
    for n, (a, b) in enumerate(itertools.pairwise(frames)):
        start, end = 10 * MILLISECOND * n, 10 * MILLISECOND * (n + 1)
        events = simulate_events(a, b, start, end, state, 0.1, 0.15, sigma, refractory, seed=5)
        found, level, k = reference.simulate_events(
            torch.from_numpy(a), torch.from_numpy(b), start, end, level, k, last, (0.1, 0.15), sigma,
            refractory, 5, MIN_THRESHOLD,
        )  # fmt: skip
        for x, y, t, _ in found.tolist():
            last[y, x] = max(int(last[y, x]), t)
        expected = found.numpy()
        np.testing.assert_array_equal(np.stack([events.x, events.y], 1), expected[:, :2])
        # One nanosecond: the kernel may fuse a multiplication and an addition.
        assert np.abs(events.t - expected[:, 2]).max() <= 1
        np.testing.assert_array_equal(events.polarity, expected[:, 3])
        np.testing.assert_allclose(state.reference, level.numpy(), atol=1e-12)
        np.testing.assert_array_equal(state.num_crossings, k.numpy())
        total += len(events.t)
    assert total > 1000


def test_summed_events_follow_log_intensity_to_within_one_threshold() -> None:
    frames = random_frames(1, 6)
    state = EventSensorState.start(frames[0])
    summed = np.zeros(frames[0].shape)
    for n, (a, b) in enumerate(itertools.pairwise(frames)):
        events = simulate_events(a, b, n * MILLISECOND, (n + 1) * MILLISECOND, state, 0.1, 0.1)
        np.add.at(summed, (events.y, events.x), 0.1 * events.polarity)
        # The level may sit one threshold above or below where the brightness turned back.
        assert np.abs(b - frames[0] - summed).max() < 0.1 + 1e-6


def test_crossing_times_are_interpolated_between_frames() -> None:
    a, b = np.zeros((1, 1), np.float32), np.full((1, 1), 0.35, np.float32)
    events = simulate_events(a, b, 0, 7 * MILLISECOND, EventSensorState.start(a), 0.1, 0.1)
    np.testing.assert_allclose(events.t, [2 * MILLISECOND, 4 * MILLISECOND, 6 * MILLISECOND], atol=1)
    assert events.polarity.tolist() == [1, 1, 1]


def test_refractory_event_is_dropped_but_moves_the_reference() -> None:
    a, b = np.zeros((1, 1), np.float32), np.full((1, 1), -0.35, np.float32)
    state = EventSensorState.start(a)
    events = simulate_events(a, b, 0, 7 * MILLISECOND, state, 0.1, 0.1, refractory_period=3 * MILLISECOND)
    np.testing.assert_allclose(events.t, [2 * MILLISECOND, 6 * MILLISECOND], atol=1)
    np.testing.assert_allclose(state.reference, -0.3, atol=1e-9)


def test_threshold_noise_has_the_given_spread_and_depends_on_the_seed() -> None:
    a, b = np.zeros((100, 150), np.float32), np.full((100, 150), 0.5, np.float32)
    first_times = {}
    for seed in (0, 1):
        events = simulate_events(a, b, 0, 10**9, EventSensorState.start(a), 0.2, 0.2, 0.02, seed=seed)
        first = np.full(a.shape, np.iinfo(np.int64).max)
        np.minimum.at(first, (events.y, events.x), events.t)
        thresholds = first * 1e-9 * 0.5
        # 15000 samples: standard errors 0.00016 and 0.00012.
        assert abs(thresholds.mean() - 0.2) < 0.001
        assert abs(thresholds.std() - 0.02) < 0.0007
        first_times[seed] = first
    assert (first_times[0] != first_times[1]).mean() > 0.99


def test_events_are_sorted_and_repeatable() -> None:
    a, b = random_frames(3, 2)
    runs = [
        simulate_events(a, b, 0, MILLISECOND, EventSensorState.start(a), 0.1, 0.1, 0.02) for _ in range(2)
    ]
    assert (np.diff(runs[0].t) >= 0).all()
    assert runs[0].t[0] > 0
    assert runs[0].t[-1] <= MILLISECOND
    for name in ("x", "y", "t", "polarity"):
        np.testing.assert_array_equal(getattr(runs[0], name), getattr(runs[1], name))


def test_unchanged_brightness_fires_nothing() -> None:
    a = random_frames(4, 1)[0]
    assert len(simulate_events(a, a.copy(), 0, MILLISECOND, EventSensorState.start(a), 0.1, 0.1).t) == 0


def test_threshold_below_the_floor_is_refused() -> None:
    a = np.zeros((2, 2), np.float32)
    with pytest.raises(ValueError, match=r"at least 0\.01"):
        simulate_events(a, a, 0, 1, EventSensorState.start(a), 0.001, 0.1)
