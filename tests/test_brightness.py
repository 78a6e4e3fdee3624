"""Brightness of all Gaussians at once, from what pixels saw one after the other."""

import numpy as np

from edslam_ti.brightness import solve_log_brightness

NONE = -1


def test_surfaces_that_pass_under_one_pixel_differ_by_its_events() -> None:
    seen = np.array([[0], [1]])  # one pixel: first Gaussian 0, then 1
    change = np.array([[0.0], [0.7]], np.float32)
    level = solve_log_brightness(seen, change, prior=np.array([-1.0, -1.0]))
    # The difference is measured; the mean stays the prior's, which weighs 0.001.
    np.testing.assert_allclose(level, [-1.35, -0.65], atol=0.002)


def test_brightness_spreads_over_a_chain_of_comparisons() -> None:
    count = 30
    truth = np.cumsum(np.random.default_rng(0).uniform(-0.3, 0.3, count))
    seen = np.stack([np.arange(count - 1), np.arange(1, count)])  # pixel k sees k, then k + 1
    change = np.stack([np.zeros(count - 1), np.diff(truth)]).astype(np.float32)
    level = solve_log_brightness(seen, change, prior=np.zeros(count), prior_weight=1e-6)
    np.testing.assert_allclose(level - level.mean(), truth - truth.mean(), atol=0.01)


def test_gaussian_that_was_never_seen_keeps_its_prior() -> None:
    seen = np.array([[0, NONE], [2, NONE]])
    level = solve_log_brightness(
        seen, np.array([[0, 9], [0.4, 9]], np.float32), prior=np.array([0, -2.5, 0.0])
    )
    np.testing.assert_allclose(level[1], -2.5, atol=1e-6)


def test_a_wrong_comparison_among_many_counts_little() -> None:
    pixels = 20
    seen = np.stack([np.zeros(pixels, int), np.ones(pixels, int)])
    change = np.stack([np.zeros(pixels), np.full(pixels, 0.5)]).astype(np.float32)
    change[1, 0] = 5.0  # least squares alone would say 0.73
    level = solve_log_brightness(seen, change, prior=np.zeros(2))
    np.testing.assert_allclose(level[1] - level[0], 0.5, atol=0.03)


def test_nothing_seen_changes_nothing() -> None:
    prior = np.array([-1.0, -0.5])
    level = solve_log_brightness(np.full((3, 4), NONE), np.ones((3, 4), np.float32), prior)
    np.testing.assert_allclose(level, prior)
