"""What events say has changed at every pixel: up to now, and up to each of several frames."""

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.event_images.change import NEWEST_BIAS, BrightnessChange, ChangeArchive
from edslam_ti.events import Events
from edslam_ti.frame import EventCounts

CAMERA = Camera(12, 9, 10.0, 10.0, 5.5, 4.0)
TIMES = (0.1, 0.15, 0.33, 0.4)  # of the frames that end chunks of different lengths


def counts(events: Events) -> EventCounts:
    return EventCounts(events, CAMERA.shape)


def test_change_is_the_sum_of_thresholds_and_half_a_one_towards_the_last() -> None:
    change = BrightnessChange((2, 3), 0.2, 0.3)
    x, y = np.array([0, 0, 2, 0], np.int16), np.array([0, 0, 1, 0], np.int16)
    events = Events(x, y, np.arange(4.0), np.array([1, 1, -1, -1], np.int8))
    change.add(EventCounts(events, (2, 3)))
    expected = np.zeros((2, 3))
    expected[0, 0], expected[1, 2] = 0.2 * 2 - 0.3 * (1 + NEWEST_BIAS), -0.3 * (1 + NEWEST_BIAS)
    np.testing.assert_allclose(change.log_brightness(), expected, atol=1e-6)
    change.reset()
    assert (change.log_brightness() == 0).all()


def test_change_up_to_now_is_the_same_however_events_are_divided(events: Events) -> None:
    whole, divided = (BrightnessChange(CAMERA.shape, 0.2, 0.3) for _ in range(2))
    whole.add(counts(events))
    for start, end in zip((0.0, *TIMES), TIMES):
        divided.add(counts(events.between(start, end)))
    np.testing.assert_array_equal(divided.log_brightness(), whole.log_brightness())


@pytest.fixture
def events() -> Events:
    random = np.random.default_rng(0)
    n = 4000
    return Events(
        random.integers(0, CAMERA.width, n).astype(np.int16),
        random.integers(0, CAMERA.height, n).astype(np.int16),
        np.sort(random.uniform(0.0, 0.4, n)),
        random.choice(np.array([-1, 1], np.int8), n),
    )


@pytest.fixture
def archive(events: Events) -> ChangeArchive:
    """Four frames; the third is not kept."""
    result = ChangeArchive(CAMERA.shape)
    for k, (start, end) in enumerate(zip((0.0, *TIMES), TIMES)):
        result.add(counts(events.between(start, end)), k, is_kept=k != 2)
    return result


def expected_change(events: Events, time: float, end: float) -> np.ndarray:
    """Return polarities up to a time, and 0.2 of the last event's and the next one's, pixel by pixel."""
    total = np.zeros(CAMERA.shape)
    for y, x in np.ndindex(CAMERA.shape):
        here = (events.y == y) & (events.x == x) & (events.t < end)
        before, after = events.polarity[here & (events.t < time)], events.polarity[here & (events.t >= time)]
        total[y, x] = before.sum() + 0.2 * before[-1:].sum() + 0.2 * after[:1].sum()
    return total


def test_change_counts_events_plus_the_bias_of_last_and_next_event(
    archive: ChangeArchive, events: Events
) -> None:
    assert archive.frames == [0, 1, 3]
    for frame in archive.frames:
        expected = expected_change(events, TIMES[frame], end=TIMES[-1])
        np.testing.assert_allclose(archive.change(frame), expected, atol=1e-6)


def test_events_of_either_polarity_count_as_their_threshold() -> None:
    archive = ChangeArchive(CAMERA.shape, positive=0.9, negative=1.1)
    x, y = np.array([3, 3, 3, 4], np.int16), np.array([2, 2, 2, 1], np.int16)
    polarity = np.array([1, 1, -1, -1], np.int8)
    archive.add(counts(Events(x, y, np.arange(4.0), polarity)), 0, is_kept=True)
    assert archive.change(0)[2, 3] == pytest.approx(2 * 0.9 - 1.1 - 0.2 * 1.1)
    assert archive.change(0)[1, 4] == pytest.approx(-1.1 - 0.2 * 1.1)


def test_next_event_may_be_many_frames_later() -> None:
    archive = ChangeArchive(CAMERA.shape)
    one = Events(np.array([3], np.int16), np.array([2], np.int16), np.array([0.5]), np.array([-1], np.int8))
    for k in range(4):
        archive.add(counts(one if k == 3 else Events.empty()), k, is_kept=True)
    assert [archive.change(k)[2, 3] for k in range(4)] == pytest.approx([-0.2, -0.2, -0.2, -1.2])


def test_archive_starts_from_zero_after_a_reset(archive: ChangeArchive, events: Events) -> None:
    before = [archive.change(k) for k in archive.frames]
    ended = archive.reset()[0]
    np.testing.assert_allclose(ended, archive.change(3), atol=1e-6)  # no next event is known yet
    later = Events(events.x[:50], events.y[:50], events.t[:50] + 1, events.polarity[:50])
    archive.add(counts(later), 4, is_kept=True)
    nothing_before = ChangeArchive(CAMERA.shape)
    nothing_before.add(counts(later), 0, is_kept=True)
    fired = np.zeros(CAMERA.shape, bool)
    fired[later.y, later.x] = True
    np.testing.assert_allclose(archive.change(4)[fired], nothing_before.change(0)[fired], atol=1e-6)
    for k, image in zip((0, 1, 3), before):  # earlier frames still learn their next event
        assert np.abs(archive.change(k) - image).max() <= 0.2 + 1e-6


def test_dropped_frames_are_gone(archive: ChangeArchive) -> None:
    archive.drop(1)
    assert archive.frames == [0, 3]


def test_thresholds_that_hardly_differ_are_not_rounded() -> None:
    archive = ChangeArchive((2, 2), positive=1.01, negative=0.99)
    x, t = np.zeros(200, np.int16), np.arange(200) / 200
    events = Events(x, x, t, np.tile(np.array([1, -1], np.int8), 100))
    archive.add(EventCounts(events, (2, 2)), 0, is_kept=True)
    assert archive.change(0)[0, 0] == pytest.approx(100 * (1.01 - 0.99), abs=0.25)  # less the bias
