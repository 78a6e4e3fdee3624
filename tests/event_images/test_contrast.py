"""The contrast threshold from a few grey images."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sequences import record_tiny_room

from edslam_ti.datasets import EventDepthSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.event_images.contrast import contrast_from_images, contrast_threshold
from edslam_ti.events import Events


@pytest.mark.slow
@pytest.mark.parametrize(("positive", "negative"), [(0.1, None), (0.2, None), (0.35, None), (0.2, 0.26)])
def test_threshold_is_found_within_ten_percent(
    tmp_path: Path, positive: float, negative: float | None
) -> None:
    folder = record_tiny_room(
        tmp_path / "room",
        duration=0.6,
        contrast_threshold=positive,
        negative_contrast_threshold=negative,
    )
    # At the very beginning of a simulation no pixel has anything left over of an earlier event.
    found = contrast_from_images(EventReplicaSequence(folder), 0.15, 1.0)
    assert found is not None
    assert found.source == "images"
    assert found.positive == pytest.approx(positive, rel=0.1)
    assert found.negative == pytest.approx(negative or positive, rel=0.1)
    assert found.deviation is not None
    assert 0 < found.deviation < 0.05 * found.value


def test_without_images_nothing_is_claimed(
    tiny_sequence: EventDepthSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiny_sequence, "image_timestamps", np.empty(0))
    assert contrast_from_images(tiny_sequence, 0.0, 1.0) is None
    monkeypatch.setattr(tiny_sequence, "image_timestamps", np.array([0.1]))
    assert contrast_from_images(tiny_sequence, 0.0, 1.0) is None


def test_settings_state_the_mean_and_images_the_ratio(tmp_path: Path) -> None:
    folder = record_tiny_room(
        tmp_path / "room", duration=0.4, contrast_threshold=0.2, negative_contrast_threshold=0.26
    )
    found = contrast_threshold(0.5, EventReplicaSequence(folder), 0.0, 1.0)
    positive, negative = found.relative
    assert (found.value, found.source) == (0.5, "settings")
    assert 0.5 * (positive + negative) == pytest.approx(1)
    assert positive / negative == pytest.approx(0.2 / 0.26, rel=0.05)


def inverted(sequence: EventDepthSequence, monkeypatch: pytest.MonkeyPatch) -> EventDepthSequence:
    """Return the sequence with polarity of its events swapped."""
    as_is = sequence.events

    def swapped(start: float, end: float) -> Events:
        events = as_is(start, end)
        return replace(events, polarity=-events.polarity)

    monkeypatch.setattr(sequence, "events", swapped)
    return sequence


def test_inverted_polarity_is_named_wherever_the_threshold_comes_from(
    tiny_sequence: EventDepthSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert contrast_threshold(None, tiny_sequence, 0.0, 1.0).notes == ()
    assert contrast_threshold(0.1, tiny_sequence, 0.0, 1.0).notes == ()
    sequence = inverted(tiny_sequence, monkeypatch)
    for stated, is_in_data, source in (
        (None, True, "data"),
        (0.2, True, "settings"),
        (None, False, "default"),
    ):
        if not is_in_data:
            monkeypatch.setattr(sequence, "contrast_threshold", None)
        found = contrast_threshold(stated, sequence, 0.0, 1.0)
        assert found.source == source
        (note,) = found.notes
        assert note.startswith("polarity looks inverted")
        assert "C = -0.1" in note
        assert found.value > 0  # it is said, not applied


def test_random_polarity_is_not_called_inverted(
    tiny_sequence: EventDepthSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    as_is, random = tiny_sequence.events, np.random.default_rng(0)

    def shuffled(start: float, end: float) -> Events:
        events = as_is(start, end)
        return replace(events, polarity=random.permutation(events.polarity))

    monkeypatch.setattr(tiny_sequence, "events", shuffled)
    assert contrast_threshold(None, tiny_sequence, 0.0, 1.0).notes == ()
