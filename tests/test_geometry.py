"""Rigid motions: exp and log undo each other at every angle, with gradients that stay finite."""

import numpy as np
import pytest
import torch

from edslam_ti.geometry import (
    from_rotation_translation,
    interpolate,
    inverse,
    orthonormalized,
    rotation_angle_deg,
    se3_exp,
    se3_log,
    skew,
)

ANGLES = [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 9.9e-4, 1.01e-3, 0.0099, 0.0101, 0.1, 1.0, 3.0, np.pi - 1e-3]


def twists(angle: float, count: int = 50, dtype: torch.dtype = torch.float64) -> torch.Tensor:  # [count, 6]
    """Return twists with random translations and rotations by the angle about random axes."""
    generator = torch.Generator().manual_seed(0)
    axes = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    axes = axes / axes.norm(dim=-1, keepdim=True)
    translations = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return torch.cat([translations, angle * axes], -1).to(dtype)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp(angle: float) -> None:
    twist = twists(angle)
    # Near pi the axis is found from sin(theta), which loses as many digits as sin(theta) is small.
    torch.testing.assert_close(se3_log(se3_exp(twist)), twist, rtol=0, atol=1e-11)


@pytest.mark.parametrize("angle", [1e-9, 1e-7, 1e-5])
def test_small_rotations_keep_their_relative_precision(angle: float) -> None:
    rotation = twists(angle)[:, 3:]
    recovered = se3_log(se3_exp(twists(angle)))[:, 3:]
    assert ((recovered - rotation).norm(dim=-1) / angle).max() < 1e-12


@pytest.mark.parametrize("angle", [1e-4, 1e-3, 1e-2, 0.1, 1.0, 3.0])
def test_exp_in_single_precision_has_no_weak_angle(angle: float) -> None:
    exact = se3_exp(twists(angle))
    # A few units in the last place of numbers up to about 3.
    rough = se3_exp(twists(angle, dtype=torch.float32))
    torch.testing.assert_close(rough.double(), exact, rtol=0, atol=2e-6)


def test_exp_agrees_with_the_matrix_exponential() -> None:
    for twist in twists(0.7, count=5):
        generator = torch.zeros(4, 4, dtype=torch.float64)
        generator[:3, :3], generator[:3, 3] = skew(twist[3:]), twist[:3]
        torch.testing.assert_close(se3_exp(twist), torch.linalg.matrix_exp(generator))


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 0.5, 2.5])
def test_gradients_of_exp_and_log_are_right(angle: float) -> None:
    twist = twists(angle, count=2).requires_grad_()
    assert torch.autograd.gradcheck(se3_exp, (twist,))
    assert torch.autograd.gradcheck(lambda x: se3_log(se3_exp(x)), (twist,))


def test_gradient_of_log_at_the_identity_is_finite() -> None:
    T = torch.eye(4, dtype=torch.float64, requires_grad=True)
    se3_log(T).sum().backward()
    assert T.grad is not None
    assert torch.isfinite(T.grad).all()
    assert T.grad.abs().sum() > 0


def test_inverse_undoes_a_motion() -> None:
    T = se3_exp(twists(1.2))
    eye = torch.eye(4, dtype=torch.float64).expand_as(T)
    torch.testing.assert_close(T @ inverse(T), eye)
    torch.testing.assert_close(inverse(T) @ T, eye)


def test_interpolation_meets_its_ends_and_its_middle_halves_the_way() -> None:
    start, end = se3_exp(twists(0.8)), se3_exp(twists(1.9).flip(0))
    torch.testing.assert_close(interpolate(start, end, 0.0), start)
    torch.testing.assert_close(interpolate(start, end, 1.0), end)
    half = interpolate(start, end, 0.5)
    torch.testing.assert_close(inverse(start) @ half, inverse(half) @ end)


def test_interpolation_between_equal_poses_stays_there() -> None:
    T = se3_exp(twists(0.8, count=1))[0]
    torch.testing.assert_close(interpolate(T, T, 0.37), T)


def test_interpolation_of_a_screw_motion_follows_it_and_extrapolates() -> None:
    twist = twists(0.9, count=1)[0]
    start = se3_exp(twists(0.4, count=2)[1])
    end = start @ se3_exp(twist)
    for fraction in (0.25, 0.75, 1.5, -0.5):
        torch.testing.assert_close(interpolate(start, end, fraction), start @ se3_exp(fraction * twist))


def test_interpolation_at_many_fractions_is_one_call() -> None:
    start, end = (se3_exp(t) for t in twists(0.6, count=2))
    fractions = torch.tensor([0.1, 0.9], dtype=torch.float64)
    together = interpolate(start, end, fractions)
    torch.testing.assert_close(together, torch.stack([interpolate(start, end, f) for f in fractions]))


def test_gradient_of_interpolation_reaches_both_ends() -> None:
    deltas = torch.zeros(2, 6, dtype=torch.float64, requires_grad=True)
    start, end = (se3_exp(t) for t in twists(0.02, count=2))

    def middle(deltas: torch.Tensor) -> torch.Tensor:
        return interpolate(start @ se3_exp(deltas[0]), end @ se3_exp(deltas[1]), 0.3)

    assert torch.autograd.gradcheck(middle, (deltas,))


def test_skew_is_the_cross_product() -> None:
    a, b = twists(1.0)[:, :3], twists(1.0)[:, 3:]
    torch.testing.assert_close((skew(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))


def test_orthonormalized_removes_drift_and_keeps_the_position() -> None:
    T = se3_exp(twists(1.0, count=1))[0].numpy()
    drifted = T.copy()
    drifted[:3, :3] += 1e-4 * np.random.default_rng(0).normal(size=(3, 3))
    R = orthonormalized(drifted)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(orthonormalized(drifted), T, atol=1e-3)
    np.testing.assert_allclose(orthonormalized(drifted)[:3, 3], T[:3, 3])


def test_rotation_angle_is_in_degrees() -> None:
    T = se3_exp(torch.tensor([1.0, 2.0, 3.0, 0.0, np.radians(30), 0.0], dtype=torch.float64)).numpy()
    assert rotation_angle_deg(T) == pytest.approx(30)
    assert rotation_angle_deg(np.eye(4)) == 0


def test_rotation_and_translation_make_a_matrix_of_any_batch_shape() -> None:
    R = torch.eye(3).expand(2, 5, 3, 3)
    T = from_rotation_translation(R, torch.ones(2, 5, 3))
    assert T.shape == (2, 5, 4, 4)
    assert T[1, 4].tolist() == [[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [0, 0, 0, 1]]


@pytest.mark.parametrize("angle", ANGLES)
def test_single_motions_agree_with_the_batched_ones(angle: float) -> None:
    for twist in twists(angle, count=5):
        T = se3_exp(twist)
        np.testing.assert_allclose(se3_exp(twist.numpy()), T.numpy(), atol=1e-15, rtol=1e-13)
        np.testing.assert_allclose(inverse(T.numpy()), inverse(T).numpy(), atol=1e-15)
        np.testing.assert_allclose(se3_log(T.numpy()), se3_log(T).numpy(), atol=1e-12, rtol=1e-9)
