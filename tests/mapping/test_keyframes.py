"""Which frames become keyframes, and the archive of what events have changed."""

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.config import KeyframeConfig
from edslam_ti.events import Events
from edslam_ti.mapping.keyframes import EventArchive, is_keyframe

CAMERA = Camera(12, 9, 10.0, 10.0, 5.5, 4.0)
TIMES = (0.1, 0.15, 0.33, 0.4)  # of the frames that end chunks of different lengths


@pytest.mark.parametrize(
    ("covisibility", "translation", "expected"),
    [(0.95, 0.05, False), (0.85, 0.1, False), (0.84, 0.05, True), (0.95, 0.11, True), (0.2, 0.5, True)],
)
def test_frame_that_sees_enough_new_or_is_far_enough_is_a_keyframe(
    covisibility: float, translation: float, expected: bool
) -> None:
    config = KeyframeConfig(min_covisibility=0.85, max_translation=0.05)
    assert is_keyframe(covisibility, translation, median_depth=2.0, config=config) == expected


def test_distance_counts_relative_to_the_depth() -> None:
    config = KeyframeConfig(min_covisibility=0.85, max_translation=0.05)
    assert is_keyframe(0.95, 0.1, median_depth=1.0, config=config)
    assert not is_keyframe(0.95, 0.1, median_depth=4.0, config=config)
    assert not is_keyframe(0.95, 0.1, median_depth=np.inf, config=config)  # nothing measured


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
def archive(events: Events) -> EventArchive:
    """Four frames; the third is not kept."""
    result = EventArchive(CAMERA.shape)
    for k, (start, end) in enumerate(zip((0.0, *TIMES), TIMES)):
        result.append(events.between(start, end), k, is_kept=k != 2)
    return result


def expected_change(events: Events, time: float, end: float) -> np.ndarray:
    """Return polarities up to a time, and 0.2 of the last event's and the next one's, pixel by pixel."""
    total = np.zeros(CAMERA.shape)
    for y, x in np.ndindex(CAMERA.shape):
        here = (events.y == y) & (events.x == x) & (events.t < end)
        before, after = events.polarity[here & (events.t < time)], events.polarity[here & (events.t >= time)]
        total[y, x] = before.sum() + 0.2 * before[-1:].sum() + 0.2 * after[:1].sum()
    return total


def test_change_counts_events_and_leans_towards_the_last_and_the_next(
    archive: EventArchive, events: Events
) -> None:
    assert archive.frames == [0, 1, 3]
    for frame in archive.frames:
        expected = expected_change(events, TIMES[frame], end=TIMES[-1])
        np.testing.assert_allclose(archive.change(frame), expected, atol=1e-6)


def test_events_of_either_polarity_count_as_their_threshold() -> None:
    archive = EventArchive(CAMERA.shape, positive=0.9, negative=1.1)
    x, y = np.array([3, 3, 3, 4], np.int16), np.array([2, 2, 2, 1], np.int16)
    polarity = np.array([1, 1, -1, -1], np.int8)
    archive.append(Events(x, y, np.arange(4.0), polarity), 0, is_kept=True)
    assert archive.change(0)[2, 3] == pytest.approx(2 * 0.9 - 1.1 - 0.2 * 1.1)
    assert archive.change(0)[1, 4] == pytest.approx(-1.1 - 0.2 * 1.1)


def test_next_event_may_come_many_frames_later() -> None:
    archive = EventArchive(CAMERA.shape)
    one = Events(np.array([3], np.int16), np.array([2], np.int16), np.array([0.5]), np.array([-1], np.int8))
    for k in range(4):
        archive.append(one if k == 3 else Events.empty(), k, is_kept=True)
    assert [archive.change(k)[2, 3] for k in range(4)] == pytest.approx([-0.2, -0.2, -0.2, -1.2])


def test_counting_begins_again_where_it_ended(archive: EventArchive, events: Events) -> None:
    before = [archive.change(k) for k in archive.frames]
    ended = archive.begin_again()
    np.testing.assert_allclose(ended, archive.change(3), atol=1e-6)  # no next event is known yet
    later = Events(events.x[:50], events.y[:50], events.t[:50] + 1, events.polarity[:50])
    archive.append(later, 4, is_kept=True)
    nothing_before = EventArchive(CAMERA.shape)
    nothing_before.append(later, 0, is_kept=True)
    fired = np.zeros(CAMERA.shape, bool)
    fired[later.y, later.x] = True
    np.testing.assert_allclose(archive.change(4)[fired], nothing_before.change(0)[fired], atol=1e-6)
    for k, image in zip((0, 1, 3), before):  # earlier frames still learn their next event
        assert np.abs(archive.change(k) - image).max() <= 0.2 + 1e-6


def test_forgotten_frames_are_gone(archive: EventArchive) -> None:
    archive.forget(1)
    assert archive.frames == [0, 3]


def test_thresholds_that_hardly_differ_are_not_rounded() -> None:
    archive = EventArchive((2, 2), positive=1.01, negative=0.99)
    x, t = np.zeros(200, np.int16), np.arange(200) / 200
    archive.append(Events(x, x, t, np.tile(np.array([1, -1], np.int8), 100)), 0, is_kept=True)
    assert archive.change(0)[0, 0] == pytest.approx(100 * (1.01 - 0.99), abs=0.25)  # less the lean
