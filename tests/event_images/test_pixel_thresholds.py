"""Each pixel's thresholds are found from what a map shows."""

import numpy as np

from edslam_ti.event_images.pixel_thresholds import Compared, fit_pixel_thresholds

SHAPE = (30, 40)


def frames(gain: np.ndarray, drift: np.ndarray, noise: float) -> list[Compared]:
    rng = np.random.default_rng(0)
    result = []
    for window in range(2):
        change, activity = np.zeros(SHAPE), np.zeros(SHAPE)
        offset = rng.normal(0, 0.05, SHAPE)  # of the start image
        for _ in range(15):
            step = rng.normal(0, 0.3, SHAPE)
            change, activity = change + step, activity + np.abs(step)
            shown = offset + gain * change + drift * activity + rng.normal(0, noise, SHAPE)
            result.append(Compared(window, shown, change, activity, np.ones(SHAPE, bool)))
    return result


def test_gain_and_drift_of_each_pixel_are_found() -> None:
    rng = np.random.default_rng(1)
    gain, drift = rng.normal(0, 0.1, SHAPE), rng.normal(0, 0.1, SHAPE)
    found = fit_pixel_thresholds(frames(gain, drift, 0.05), SHAPE)
    assert np.corrcoef(found.drift.ravel(), drift.ravel())[0, 1] > 0.95
    assert np.corrcoef(found.gain.ravel(), gain.ravel())[0, 1] > 0.8
    assert 0.08 < found.spread < 0.12


def test_pixels_that_are_alike_stay_alike() -> None:
    zero = np.zeros(SHAPE)
    assert fit_pixel_thresholds(frames(zero, zero, 0.05), SHAPE).spread < 0.02


def test_what_neighbours_share_is_the_maps_error() -> None:
    slow = np.broadcast_to(np.linspace(-0.1, 0.1, SHAPE[1]), SHAPE)
    found = fit_pixel_thresholds(frames(np.zeros(SHAPE), slow, 0.02), SHAPE)
    assert np.abs(found.drift[:, 10:-10]).max() < 0.04
