"""Change missed in dead time, beside what a blind pixel really misses."""

import numpy as np

from edslam_ti.events import Events
from edslam_ti.frame import MissedChange

DEAD, C = 5e-4, 0.2


def sensed(rate: float, duration: float, start: float = 0.0) -> list[float]:
    """Return the times of events of a pixel whose log brightness changes at a rate, 1/s."""
    times, wake = [], start
    while (now := wake + C / rate) < start + duration:
        times.append(now)
        wake = now + DEAD
    return times


def events(times: list[float], polarity: list[int]) -> Events:
    zeros = np.zeros(len(times), np.int16)
    return Events(zeros, zeros, np.array(times), np.array(polarity, np.int8))


def test_a_steady_change_is_restored() -> None:
    rate, duration = 300.0, 0.05
    times = sensed(rate, duration)
    missed = MissedChange((1, 1), DEAD).of(events(times, [1] * len(times)))
    measured = C * (len(times) + missed[0, 0, 1])
    assert C * len(times) < 0.6 * rate * duration
    assert abs(measured - rate * duration) < 0.05 * rate * duration
    assert missed[0, 0, 0] == 0


def test_chunks_give_the_same_as_one() -> None:
    times = sensed(300.0, 0.05)
    all_events = events(times, [1] * len(times))
    whole = MissedChange((1, 1), DEAD).of(all_events)
    parts = MissedChange((1, 1), DEAD)
    total = parts.of(all_events[:20]) + parts.of(all_events[20:])
    np.testing.assert_allclose(total, whole, rtol=1e-6)


def test_a_turn_misses_nothing_between_its_two_events() -> None:
    missed = MissedChange((1, 1), DEAD).of(events([0.01, 0.011], [1, -1]))
    assert not missed.any()


def test_an_event_counts_as_six_at_most() -> None:
    missed = MissedChange((1, 1), DEAD).of(events([0.01, 0.01 + DEAD], [1, 1]))
    assert missed.max() <= 5.0 + 1e-6
