"""Sigmas of poses: as large as the errors, growing where nothing is measured."""

from dataclasses import replace

import numpy as np
import pytest
from sequences import settings, tracked, without_depth, without_events

from edslam_ti.datasets import EventDepthSequence, Sample, SampledSequence
from edslam_ti.datasets.altered import AlteredSequence
from edslam_ti.geometry import inverse, se3_exp
from edslam_ti.kernels.patch_warp import NormalEquations
from edslam_ti.slam import Slam
from edslam_ti.tracking.tracker import Measurement, TrackingResult
from edslam_ti.tracking.uncertainty import INFLATION, absolute_covariances, covariance, measured, sigmas
from edslam_ti.trajectory import Trajectory


def system(H: np.ndarray, cost: float = 50.0, num: int = 100) -> NormalEquations:
    return NormalEquations(H, np.zeros(6), cost, num, 0, num)


def test_covariance_is_the_inverse_information_scaled_by_the_residuals() -> None:
    H = np.diag([4.0, 4.0, 4.0, 100.0, 100.0, 100.0])
    found = covariance([system(H)])  # mean square of normalised residuals: 1
    assert found is not None
    np.testing.assert_allclose(np.diag(found), INFLATION / np.diag(H))
    four_times = covariance([system(H, cost=200.0)])
    assert four_times is not None
    np.testing.assert_allclose(four_times, 4 * found)
    both = covariance([system(H), system(H)])
    assert both is not None
    np.testing.assert_allclose(both, found / 2)


def test_unobserved_motion_has_no_covariance() -> None:
    assert covariance([system(np.diag([1.0, 1, 1, 1, 1, 0]))]) is None
    assert covariance([system(np.full((6, 6), np.nan))]) is None
    assert measured(3, [system(np.zeros((6, 6)))]) is None


def test_uncertainty_adds_up_from_reference_to_reference() -> None:
    step = 1e-4 * np.eye(6)
    poses = [se3_exp(k * np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])) for k in range(4)]
    results = [
        TrackingResult(T, True, 1.0, measurement=None if k == 0 else Measurement(reference, step))
        for k, (T, reference) in enumerate(zip(poses, (0, 0, 0, 2)))
    ]
    found = absolute_covariances(results, Trajectory(np.arange(4.0), np.array(poses)))
    assert (found[0] == 0).all()
    np.testing.assert_allclose(found[1], step)
    np.testing.assert_allclose(found[2], step)
    # Frame 3 stands 0.1 m from its reference: that one's rotation adds to its position.
    np.testing.assert_allclose(np.diag(found[3]), 2e-4 + np.array([0, 1e-6, 1e-6, 0, 0, 0]))
    position, rotation = sigmas(found)
    assert position[1] == pytest.approx(np.sqrt(3e-4))
    assert rotation[1] == pytest.approx(np.degrees(np.sqrt(3e-4)))


def errors_and_sigmas(slam: Slam, sequence: EventDepthSequence) -> tuple[np.ndarray, np.ndarray]:
    poses = slam.trajectory.poses
    truth = [sequence.true_pose(t) for t in slam.trajectory.timestamps]
    errors = np.array(
        [np.linalg.norm((inverse(a) @ b)[:3, 3]) for a, b in zip(truth, poses) if a is not None]
    )
    return errors, sigmas(absolute_covariances(slam.results, slam.trajectory))[0]


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["none", "kinect"])
@pytest.mark.parametrize("method", ["ed_slam", "ed_slam_paper"])
def test_sigmas_are_of_the_size_of_the_errors(
    tiny_sequence: EventDepthSequence, noise: str, method: str
) -> None:
    sequence = AlteredSequence(tiny_sequence, noise)
    slam = tracked(sequence, list(SampledSequence(sequence, 0.0, None, 0.1)), settings(method))
    errors, expected = errors_and_sigmas(slam, sequence)
    ratio = np.median(errors[1:] / expected[1:])
    assert 0.1 < ratio < 5


def test_a_blackout_raises_the_sigma_until_a_measurement_follows(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    dark = range(7, 11)
    blind = [without_depth(without_events(s)) if k in dark else s for k, s in enumerate(tiny_samples)]
    slam = tracked(tiny_sequence, blind)
    _, expected = errors_and_sigmas(slam, tiny_sequence)
    assert (np.diff(expected[6:11]) > 0.002).all()  # metres; steps of 1 cm add up in squares
    assert all(slam.results[k].measurement is None for k in dark)


def test_a_lost_frame_is_not_measured(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> None:
    lost = replace(tiny_samples[3], depth=None, events=without_events(tiny_samples[3]).events)
    slam = tracked(tiny_sequence, [*tiny_samples[:3], lost])
    assert not slam.results[-1].converged
    assert slam.results[-1].measurement is None
