"""Time surface and accumulated polarity (Eq. 1, Eq. 11)."""

import numpy as np
import pytest
import torch

from edslam_ti import kernels
from edslam_ti.kernels import reference
from edslam_ti.kernels.time_surface import MANY_EVENTS, count_events, time_surface, update_last_timestamps

SHAPE = (12, 16)


def make_events(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = rng.integers(0, SHAPE[1], n).astype(np.int16)
    y = rng.integers(0, SHAPE[0], n).astype(np.int16)
    return x, y, np.sort(rng.uniform(0, 1, n)), rng.choice([-1, 1], n).astype(np.int8)


def test_surface_matches_the_twin_over_several_batches() -> None:
    x, y, t, _ = make_events(500, 0)
    last = np.full(SHAPE, -np.inf)
    for part in np.array_split(np.arange(500), 3):
        update_last_timestamps(x[part], y[part], t[part], last)
    expected = reference.last_timestamps(*map(torch.from_numpy, (x, y, t)), SHAPE)
    assert np.array_equal(last, expected.numpy())
    ours = time_surface(last, 1.0, 0.03)
    assert np.allclose(ours, reference.time_surface(expected, 1.0, 0.03).numpy(), atol=1e-6)


def test_surface_is_one_at_a_fresh_event_and_zero_without_events() -> None:
    last = np.full(SHAPE, -np.inf)
    update_last_timestamps(np.array([3], np.int16), np.array([5], np.int16), np.array([0.5]), last)
    surface = time_surface(last, 0.5, 0.02)
    assert surface[5, 3] == 1
    assert surface.sum() == 1
    assert time_surface(last, 0.52, 0.02)[5, 3] == pytest.approx(np.exp(-1), abs=1e-6)


def test_microseconds_survive_at_late_times() -> None:
    last = np.full(SHAPE, -np.inf)
    update_last_timestamps(np.array([0], np.int16), np.array([0], np.int16), np.array([3600.0]), last)
    ratio = -np.log(time_surface(last, 3600.000001, 1e-5)[0, 0]) * 1e-5
    assert ratio == pytest.approx(1e-6, rel=1e-3)


def test_event_counts_and_newest_polarity_match_the_twin() -> None:
    x, y, _, polarity = make_events(2000, 1)
    counts, last = np.zeros((*SHAPE, 2), np.int32), np.zeros(SHAPE, np.int8)
    for part in (slice(0, 700), slice(700, 700), slice(700, 2000)):  # one of them empty
        count_events(x[part], y[part], polarity[part], counts, last)
    twin = reference.count_events(*map(torch.from_numpy, (x, y, polarity)), SHAPE)
    assert np.array_equal(counts, twin.numpy())
    expected = np.zeros(SHAPE, np.int8)
    expected[y, x] = polarity  # of repeated pixels the last one stays
    assert np.array_equal(last, expected)


def test_events_outside_the_image_are_not_counted() -> None:
    counts, last = np.zeros((*SHAPE, 2), np.int32), np.zeros(SHAPE, np.int8)
    place = np.array([16], np.int16)
    with pytest.raises(ValueError, match="0 <= x < 16"):
        count_events(place, place, np.ones(1, np.int8), counts, last)
    assert not counts.any()


def test_events_outside_the_image_are_refused() -> None:
    last = np.full(SHAPE, -np.inf)
    with pytest.raises(ValueError, match="0 <= x < 16"):
        update_last_timestamps(np.array([16], np.int16), np.array([0], np.int16), np.array([0.0]), last)


def test_large_batches_match_the_twin_and_events_outside_change_nothing() -> None:
    rng = np.random.default_rng(3)
    n, shape = MANY_EVENTS + 1, (30, 40)
    x, y = rng.integers(0, 40, n).astype(np.int16), rng.integers(0, 30, n).astype(np.int16)
    t = np.sort(rng.uniform(0, 1, n))
    last = np.full(shape, -np.inf)
    update_last_timestamps(x, y, t, last)
    expected = reference.last_timestamps(*(torch.from_numpy(a) for a in (x, y, t)), shape)
    assert np.array_equal(last, expected.numpy())
    before = last.copy()
    y[-1] = 30
    with pytest.raises(ValueError, match="0 <= y < 30"):
        update_last_timestamps(x, y, t + 1, last)
    assert np.array_equal(last, before)


@pytest.mark.parametrize("silent", ["no pixel", "one pixel", "one pixel, late"])
def test_large_batches_match_the_twin_wherever_the_newest_event_lies(silent: str) -> None:
    x, y, t, _ = make_events(MANY_EVENTS + 1, 7)
    at_pixel = (x == 5) & (y == 3)
    if silent == "one pixel":
        x[at_pixel] = 6
    elif silent == "one pixel, late":  # its newest event is among the oldest
        x[at_pixel & (np.arange(len(x)) > 2000)] = 6
    last = np.full(SHAPE, -np.inf)
    update_last_timestamps(x, y, t, last)
    expected = reference.last_timestamps(*(torch.from_numpy(a) for a in (x, y, t)), SHAPE)
    assert np.array_equal(last, expected.numpy())
    assert np.isinf(last[3, 5]) == (silent == "one pixel")


@pytest.mark.parametrize("n", [500, MANY_EVENTS + 3])
def test_polarities_have_surfaces_of_their_own(n: int) -> None:
    x, y, t, polarity = make_events(n, 4)
    last = np.full((2, *SHAPE), -np.inf)
    update_last_timestamps(x, y, t, last, polarity)
    for k, sign in enumerate((-1, 1)):
        part = polarity == sign
        expected = reference.last_timestamps(*(torch.from_numpy(a[part]) for a in (x, y, t)), SHAPE)
        assert np.array_equal(last[k], expected.numpy())


def test_surfaces_by_polarity_need_polarities() -> None:
    x, y, t, polarity = make_events(10, 5)
    with pytest.raises(ValueError, match="without polarities"):
        update_last_timestamps(x, y, t, np.full((2, *SHAPE), -np.inf))
    with pytest.raises(ValueError, match="with polarities"):
        update_last_timestamps(x, y, t, np.full(SHAPE, -np.inf), polarity)


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 3])
def test_any_number_of_threads_keeps_the_newest_event(device: str, threads: int) -> None:
    x, y, t, _ = make_events(MANY_EVENTS + 2, 6)
    last = np.full(SHAPE, -np.inf)
    kernels.init(device, threads=threads)
    update_last_timestamps(x, y, t, last)
    kernels.init(device, threads=2)
    expected = reference.last_timestamps(*(torch.from_numpy(a) for a in (x, y, t)), SHAPE)
    assert np.array_equal(last, expected.numpy())


def test_negative_pixels_are_refused() -> None:
    with pytest.raises(ValueError, match="got x -1 to -1"):
        update_last_timestamps(
            np.array([-1], np.int16), np.array([0], np.int16), np.zeros(1), np.zeros(SHAPE)
        )
