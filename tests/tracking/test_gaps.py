"""Gaps in the events: noticed by their number, closed by a correction of the poses inside."""

import numpy as np
import pytest

from edslam_ti.geometry import inverse, se3_exp, se3_log
from edslam_ti.tracking.gaps import EventRate, bridge
from edslam_ti.trajectory import PathDraft, Trajectory

VELOCITY = np.array([0.05, 0.0, 0.02, 0.0, 0.1, 0.0])  # a frame; metres, radians


def rate(*counts: int) -> EventRate:
    result = EventRate(silent_share=0.02, slowing_share=0.2)
    for count in counts:
        result.add(count)
    return result


def test_few_events_are_silence_only_relative_to_many() -> None:
    assert not rate(5).is_silent
    assert not rate(1000, 21).is_silent
    assert rate(1000, 19).is_silent
    assert not rate(1000, 19, 900).is_silent
    assert rate(*[1000] * 5, *[0] * 50).is_silent  # silent frames do not become usual


def test_a_camera_that_comes_to_rest_has_few_events_before_it_is_silent() -> None:
    assert rate(1000, 150, 5).was_slowing
    assert not rate(1000, 1000, 5).was_slowing


def path_with_gap(correction: np.ndarray) -> tuple[PathDraft, np.ndarray]:
    """Return a path at constant velocity, wrong by `correction` from frame 6 on, stuck at frame 3 before."""
    true = np.array([se3_exp(k * VELOCITY) for k in range(10)])
    wrong = np.array([true[min(k, 3)] if k < 6 else inverse(correction) @ true[k] for k in range(10)])
    draft = PathDraft(Trajectory(np.arange(9.0), wrong[:9]))
    draft.newest = wrong[9]
    return draft, true


def test_frames_after_a_gap_move_by_the_correction_and_those_inside_along_a_cubic() -> None:
    correction = se3_exp(np.array([0.2, 0.0, 0.1, 0.0, 0.1, 0.0]))
    draft, true = path_with_gap(correction)
    bridge(draft, before=3, after=6, correction=correction)
    for k in range(6, 10):
        np.testing.assert_allclose(draft.pose(k), true[k], atol=1e-12)
    for k in (4, 5):  # at constant velocity the cubic is the straight line
        np.testing.assert_allclose(draft.pose(k), true[k], atol=1e-9)
    assert sorted(draft.corrections) == [4, 5, 6, 7, 8]  # the newest pose is no correction
    assert (draft.trajectory.pose(4) == draft.trajectory.pose(3)).all()  # nothing is written to it


def test_a_small_correction_is_distributed_evenly_over_the_gap() -> None:
    correction = se3_exp(np.array([0.009, 0.0, 0.0, 0.0, 0.0, 0.0]))
    draft, _ = path_with_gap(correction)
    before = [draft.pose(k) for k in range(10)]
    bridge(draft, before=3, after=6, correction=correction)
    for k, share in ((3, 0.0), (4, 1 / 3), (5, 2 / 3), (6, 1.0)):
        moved = se3_log(draft.pose(k) @ inverse(before[k]))
        assert moved[0] == pytest.approx(0.009 * share, abs=1e-12)
