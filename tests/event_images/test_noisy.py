"""Pixels that fire by themselves are found early, and neighbours stand in for them."""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from edslam_ti.event_images.noisy import NoisyPixels
from edslam_ti.events import Events
from edslam_ti.frame import EventCounts

SHAPE = (30, 40)
FRAME = 0.05  # s


def frames(rates: dict[tuple[int, int], float], count: int) -> Iterator[EventCounts]:
    """Yield events of 100 Hz a pixel, on average and more at edges, and of noisy pixels [row, column]."""
    random = np.random.default_rng(0)
    for _ in range(count):
        numbers = random.poisson(np.where(np.arange(SHAPE[1]) % 10 < 5, 1, 9), SHAPE)
        for pixel, rate in rates.items():
            numbers[pixel] += round(rate * FRAME)
        y, x = np.divmod(np.repeat(np.arange(numbers.size), numbers.ravel()), SHAPE[1])
        t, polarity = np.zeros(len(x)), np.ones(len(x), np.int8)
        yield EventCounts(Events(x.astype(np.int16), y.astype(np.int16), t, polarity), SHAPE)


@pytest.mark.parametrize("rate", [20_000, 5_000])
def test_pixels_at_kilohertz_are_found_in_the_first_frame(rate: float) -> None:
    noisy = NoisyPixels(SHAPE)
    places = [(0, 0), (7, 12), (8, 12), (20, 33)]  # in a corner, beside one another, in the open
    noisy.add(next(frames(dict.fromkeys(places, rate), 1)))
    assert [tuple(p) for p in np.argwhere(noisy.mask).tolist()] == places


def test_edges_are_not_noisy() -> None:
    noisy = NoisyPixels(SHAPE)
    for counts in frames({}, 60):
        noisy.add(counts)
        assert not noisy.mask.any()
        assert noisy.num_other_events(counts) == counts.numbers.sum()


def test_a_lone_pixel_in_the_dark_is_found_and_a_whole_patch_is_not() -> None:
    noisy = NoisyPixels(SHAPE)
    numbers = np.zeros(SHAPE, int)
    numbers[5, 5] = 101
    numbers[10:20, 10:20] = 1000
    y, x = (a.astype(np.int16) for a in np.nonzero(numbers))
    times = numbers[y, x]
    events = Events(
        np.repeat(x, times), np.repeat(y, times), np.zeros(times.sum()), np.ones(times.sum(), np.int8)
    )
    noisy.add(EventCounts(events, SHAPE))
    expected = numbers > np.maximum(10 * cv2.medianBlur(numbers.astype(np.float32), 5), 100)
    assert (noisy.mask == expected).all()
    assert noisy.mask[5, 5]
    assert not noisy.mask[11:19, 11:19].any()


def test_only_noisy_pixels_are_replaced_by_their_neighbours() -> None:
    noisy = NoisyPixels(SHAPE)
    image = np.random.default_rng(1).normal(size=SHAPE).astype(np.float32)
    assert noisy.replaced(image) is image
    counts = next(frames({(7, 12): 5_000}, 1))
    noisy.add(counts)
    before = image.copy()
    result = noisy.replaced(image)
    assert (image == before).all()
    assert result[7, 12] == np.median(image[5:10, 10:15])
    assert (np.delete(result.ravel(), 7 * SHAPE[1] + 12) == np.delete(image.ravel(), 7 * SHAPE[1] + 12)).all()
    assert noisy.num_other_events(counts) == counts.numbers.sum() - counts.numbers[7, 12].sum()
