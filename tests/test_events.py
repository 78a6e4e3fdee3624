"""Slices of an event stream."""

import itertools

import numpy as np
import pytest

from edslam_ti.errors import DataError
from edslam_ti.events import Events


def stream(t: list[float]) -> Events:
    n = len(t)
    return Events(
        np.arange(n, dtype=np.int16), np.zeros(n, np.int16), np.array(t, np.float64), np.ones(n, np.int8)
    )


def test_slice_includes_its_start_and_excludes_its_end() -> None:
    events = stream([0.0, 0.1, 0.1, 0.2, 0.3])
    assert events.between(0.1, 0.3).x.tolist() == [1, 2, 3]
    assert len(events.between(0.3, 0.3)) == 0
    assert len(events.between(5.0, 6.0)) == 0


def test_consecutive_slices_part_the_stream() -> None:
    events = stream(sorted(np.random.default_rng(0).random(100)))
    edges = np.linspace(0, 1, 8)
    parts = [events.between(a, b) for a, b in itertools.pairwise(edges)]
    whole = Events.concatenate(parts)
    np.testing.assert_array_equal(whole.x, events.x)
    np.testing.assert_array_equal(whole.t, events.t)


def test_slices_are_views_of_one_memory() -> None:
    events = stream([0.0, 0.1, 0.2])
    assert np.shares_memory(events.between(0.0, 0.15).t, events.t)


def test_nothing_concatenates_to_nothing() -> None:
    assert len(Events.concatenate([])) == 0
    assert len(Events.empty()) == 0
    assert Events.empty().x.dtype == np.int16
    assert Events.empty().polarity.dtype == np.int8


def test_arrays_of_different_lengths_are_refused() -> None:
    with pytest.raises(DataError, match=r"one length, got \[2, 3\]"):
        Events(np.zeros(3, np.int16), np.zeros(3, np.int16), np.zeros(2), np.zeros(3, np.int8))
