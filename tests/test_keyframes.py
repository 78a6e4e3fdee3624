"""Which frames become keyframes, and the archive of events between any two times."""

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.config import KeyframeConfig
from edslam_ti.events import Events
from edslam_ti.frame import Frame
from edslam_ti.keyframes import EventArchive, is_keyframe

CAMERA = Camera(12, 9, 10.0, 10.0, 5.5, 4.0)
BINS = 5


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
    """Four chunks of different lengths from 0 to 0.4 s."""
    result = EventArchive(CAMERA.shape, BINS)
    surface = np.zeros(CAMERA.shape, np.float32)
    for start, end in ((0.0, 0.1), (0.1, 0.15), (0.15, 0.33), (0.33, 0.4)):
        result.append(Frame(end, start, events.between(start, end), CAMERA, surface, None, None))
    return result


def counted(events: Events, start: float, end: float) -> np.ndarray:
    """Return the sum of polarities, event by event."""
    total = np.zeros(CAMERA.shape, int)
    part = events.between(start, end)
    np.add.at(total, (part.y, part.x), part.polarity)
    return total


def test_sum_between_any_two_edges_is_the_count_of_the_events_between(
    archive: EventArchive, events: Events
) -> None:
    random = np.random.default_rng(1)
    edges = [(chunk, b) for chunk in range(len(archive)) for b in range(BINS)]
    assert len(edges) == 20
    for _ in range(60):
        a, b = sorted(random.choice(len(edges), 2, replace=False))
        start, end = (archive.edges[chunk][k] for chunk, k in (edges[a], edges[b]))
        assert start < end
        sums = archive.sum_before(*edges[b]) - archive.sum_before(*edges[a])
        assert (sums == counted(events, start, end)).all()


def test_forgotten_chunks_keep_their_starts(archive: EventArchive, events: Events) -> None:
    archive.forget_details(keep={1, 7})
    assert [len(archive.times(chunk)) for chunk in range(4)] == [1, BINS, 1, 1]
    assert [archive.times(chunk)[0] for chunk in range(4)] == pytest.approx([0, 0.1, 0.15, 0.33])
    sums = archive.sum_before(3, 0) - archive.sum_before(1, 2)
    assert (sums == counted(events, 0.12, 0.33)).all()


def test_chunk_without_events_adds_nothing(archive: EventArchive) -> None:
    surface = np.zeros(CAMERA.shape, np.float32)
    archive.append(Frame(0.5, 0.4, Events.empty(), CAMERA, surface, None, None))
    archive.append(Frame(0.6, 0.5, Events.empty(), CAMERA, surface, None, None))
    assert (archive.sum_before(5, 3) == archive.sum_before(4, 0)).all()


def test_memory_is_one_image_a_forgotten_chunk(archive: EventArchive) -> None:
    before = archive.sum_before(2, 0)
    archive.forget_details(keep=set())
    assert archive.sum_before(2, 0) is before
    assert before.dtype == np.int16
