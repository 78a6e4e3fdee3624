"""When depth contradicts events: the limits, and whole runs with images of another time or of nothing."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from sequences import ate_cm, make_slam, settings, tracked

from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.slam import Slam
from edslam_ti.tracking.depth_check import (
    MOST_IN_A_ROW,
    DepthCheck,
    is_contradiction,
    left_out,
    of_other_scale,
    sets_to_try,
)

pytestmark = pytest.mark.slow  # whole runs, or processes of their own


def test_a_contradiction_is_far_beyond_what_is_usual_and_fits_worse() -> None:
    assert is_contradiction(flow=2.0, usual=0.05, misfit=0.09, misfit_without=0.05)
    assert not is_contradiction(flow=0.4, usual=0.05, misfit=0.09, misfit_without=0.05)  # small
    assert not is_contradiction(flow=2.0, usual=0.7, misfit=0.09, misfit_without=0.05)  # usual
    assert not is_contradiction(flow=0.9, usual=0.05, misfit=0.051, misfit_without=0.05)  # fits as well
    assert is_contradiction(flow=1.8, usual=0.02, misfit=0.051, misfit_without=0.05)  # but far away
    assert not is_contradiction(flow=1.8, usual=0.02, misfit=0.002, misfit_without=0.001)  # hardly a texture
    assert not is_contradiction(
        flow=1.8, usual=0.02, misfit=0.049, misfit_without=0.05
    )  # brightness is wrong


def test_after_some_frames_in_a_row_brightness_is_in_doubt() -> None:
    check = DepthCheck()
    check.begin([0.0, 0.02, 0.03])
    judged = [check.contradicts(5.0, 0.1, 0.04) for _ in range(MOST_IN_A_ROW + 1)]
    assert judged == [True] * MOST_IN_A_ROW + [False]


def test_all_sets_are_tried_where_they_are_few() -> None:
    assert len(sets_to_try([0, 1, 2, 3, 4], 2, frozenset())) == 10
    assert sets_to_try(list(range(9)), 2, frozenset({3}))[:2] == [frozenset({0, 3}), frozenset({1, 3})]


def test_frames_are_named() -> None:
    assert left_out([4]).startswith("depth of frame 4 contradicts")
    assert left_out([0, 3, 5]).startswith("depth of frames 0, 3 and 5 contradicts")


def swapped(samples: list[Sample], a: int, b: int) -> list[Sample]:
    """Return samples of which two have each other's depth image."""
    changed = list(samples)
    changed[a] = replace(samples[a], depth=samples[b].depth)
    changed[b] = replace(samples[b], depth=samples[a].depth)
    return changed


def distrusted(slam: Slam) -> list[int]:
    return sorted(k for result in slam.results for k in result.distrusted)


@pytest.mark.parametrize(("a", "b"), [(1, 5), (2, 11), (8, 11), (0, 4), (0, 3)])
def test_swapped_depth_images_are_left_out(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample], a: int, b: int
) -> None:
    slam = tracked(tiny_sequence, swapped(tiny_samples, a, b))
    assert distrusted(slam) == [a, b]
    # Trusting them makes it ten times this.
    assert ate_cm(slam, tiny_sequence) < 0.2
    messages = " / ".join(r.message for r in slam.results)
    assert "contradicts events and its neighbours: left out" in messages
    assert all(r.converged for r in slam.results)


@pytest.mark.parametrize(
    "change",
    [
        lambda d: np.random.default_rng(0).permuted(d),
        lambda d: 1.1 * d,
        lambda d: np.where(d < np.percentile(d, 20), 10 * d, 0),  # the rest is out of range
    ],
)
def test_a_frame_whose_depth_is_nonsense_has_its_pose_by_brightness(
    tiny_sequence: EventDepthSequence,
    tiny_samples: list[Sample],
    change: Callable[[np.ndarray], np.ndarray],
) -> None:
    samples = list(tiny_samples)
    depth = samples[9].depth
    assert depth is not None
    samples[9] = replace(samples[9], depth=change(depth).astype(np.float32))
    slam = tracked(tiny_sequence, samples)
    assert distrusted(slam) == [9]
    assert slam.results[9].converged
    assert ate_cm(slam, tiny_sequence) < 0.2


@pytest.mark.parametrize("factor", [10.0, 1.4, 0.5])
def test_depth_of_another_scale_in_the_first_frame_is_left_out(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample], factor: float
) -> None:
    samples = list(tiny_samples)
    depth = samples[0].depth
    assert depth is not None
    nearby = np.where(depth < np.median(depth), depth, 0)  # the rest is out of a sensor's range
    samples[0] = replace(samples[0], depth=(factor * nearby).astype(np.float32))
    slam = tracked(tiny_sequence, samples)
    assert distrusted(slam) == [0]
    assert ate_cm(slam, tiny_sequence) < 0.3


def test_frames_that_differ_in_scale_from_all_others_are_found() -> None:
    def ratios(scales: list[float]) -> np.ndarray:
        logs = np.log(scales)
        return np.abs(logs[:, None] - logs)

    assert of_other_scale(ratios([10, 1, 1.01, 1.02, 1])) == [0]
    assert of_other_scale(ratios([1, 2, 1, 0.5, 1])) == [1, 3]
    assert of_other_scale(ratios([1, 1.05, 1.1, 1.15, 1.2])) == []  # the view changes step by step
    assert of_other_scale(ratios([2, 1, 1.2, 1, 1])) == []  # others do not agree
    assert of_other_scale(ratios([2, 1])) == []  # nobody knows which
    unknown = ratios([10, 1, 1, 1])
    unknown[0] = math.nan
    assert of_other_scale(unknown) == []


def test_right_depth_is_kept(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> None:
    assert distrusted(tracked(tiny_sequence, tiny_samples)) == []


def test_depth_that_is_wrong_all_along_is_not_left_out(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    # 50 ms late: no frame is worse than the others, which is for the check of the whole run to say.
    late = [replace(s, depth=b.depth) for b, s in itertools.pairwise(tiny_samples)]
    assert len(distrusted(tracked(tiny_sequence, late))) <= 1


def test_the_map_forgets_what_wrong_depth_has_added(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    config = settings(mapping={"iterations": 1, "final_iterations": 1})
    slam = make_slam(tiny_sequence, tiny_samples, config)
    for sample in swapped(tiny_samples, 1, 5):
        slam.process(sample)
    wrong = distrusted(slam)
    assert 1 in wrong
    mapper = slam.mapper
    assert mapper is not None
    frames = set(mapper.gaussians._frames.tolist())  # type: ignore[attr-defined]
    assert frames
    assert not frames & set(wrong)
    assert all(mapper.images.depth(k) is None for k in wrong)  # type: ignore[attr-defined]


@pytest.mark.parametrize(("every", "is_noted"), [(4, False), (16, True)])
def test_rows_of_depth_track_and_few_are_named(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample], every: int, is_noted: bool
) -> None:
    samples = []
    for s in tiny_samples:
        assert s.depth is not None
        is_row = (np.arange(len(s.depth)) % every == 0)[:, None]
        samples.append(replace(s, depth=np.where(is_row, s.depth, np.float32(0))))
    slam = tracked(tiny_sequence, samples)
    messages = [r.message for r in slam.results if "of the pixels have depth" in r.message]
    assert len(messages) == is_noted
    if not is_noted:  # all rows: 0.04 cm
        assert ate_cm(slam, tiny_sequence) < 0.4
