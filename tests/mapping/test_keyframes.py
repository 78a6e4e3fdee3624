"""Which frames become keyframes."""

import numpy as np
import pytest

from edslam_ti.config import KeyframeConfig
from edslam_ti.mapping.keyframes import is_keyframe


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
