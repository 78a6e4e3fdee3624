"""Eq. 10 to 16 on numbers worked out by hand."""

import math

import pytest
import torch

from edslam_ti.camera import Camera
from edslam_ti.config import MappingConfig
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.losses import brightness_change, depth_loss, event_loss, scale_loss, view_loss
from edslam_ti.mapping.rendering import render

CAMERA = Camera(40, 30, 30.0, 30.0, 19.5, 14.5)
BACKGROUND, EPSILON = 0.4, 1 / 255


def scattered_map() -> GaussianMap:
    """Return Gaussians at random places in front of the camera."""
    generator = torch.Generator().manual_seed(2)
    means = torch.rand(100, 3, generator=generator) * torch.tensor([2.0, 1.6, 1.0]) + torch.tensor(
        [-1, -0.8, 1]
    )
    gaussians = GaussianMap(MappingConfig())
    scales = 0.02 + 0.08 * torch.rand(100, 3, generator=generator)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(100, 1)
    gaussians.add(means, quats, scales, 0.7, torch.rand(100, 1, generator=generator))
    return gaussians


def gradients(gaussians: GaussianMap, loss: torch.Tensor) -> list[torch.Tensor]:
    return [loss.detach(), *torch.autograd.grad(loss, list(gaussians.raw.values()))]


def assert_close(ours: list[torch.Tensor], theirs: list[torch.Tensor]) -> None:
    for a, b in zip(ours, theirs, strict=True):
        assert float((a - b).norm()) <= 1e-4 * float(b.norm()) + 1e-9  # float32, in another order


@pytest.mark.parametrize("has_depth", [True, False])
def test_view_loss_is_the_losses_of_a_rendered_view(has_depth: bool) -> None:
    gaussians, pose = scattered_map(), torch.eye(4, dtype=torch.float64)
    generator = torch.Generator().manual_seed(3)
    target = torch.log(0.1 + 0.8 * torch.rand(30, 40, generator=generator))
    depth = 1 + torch.rand(30, 40, generator=generator) if has_depth else None
    shown = gaussians.activated()
    ours = view_loss(shown, CAMERA, pose, target, depth, BACKGROUND, EPSILON, (2.0, 0.5))
    view = render(gaussians.activated(), CAMERA, pose, BACKGROUND)
    difference = torch.log(view.intensity + EPSILON) - target
    theirs = 2 * difference.square().mean()
    if depth is not None:
        theirs = theirs + 0.5 * depth_loss(view.depth, view.alpha, depth)
    torch.testing.assert_close(ours.difference, difference.detach(), atol=1e-5, rtol=1e-5)
    assert_close(gradients(gaussians, ours.loss), gradients(gaussians, theirs))


def test_brightness_change_is_the_difference_of_logarithms() -> None:
    change = brightness_change(torch.tensor([[0.1, 0.5]]), torch.tensor([[0.2, 0.5]]), epsilon=0.1)
    torch.testing.assert_close(change, torch.tensor([[math.log(0.3 / 0.2), 0.0]]))


def test_event_loss_is_the_error_as_a_share_of_the_measured_square() -> None:
    measured = torch.tensor([[0.3, 0.0], [0.0, -0.4]])  # mean square 0.0625
    predicted = torch.tensor([[0.2, 0.0], [0.1, -0.4]])  # mean square error 0.005
    torch.testing.assert_close(event_loss(predicted, measured), torch.tensor(0.005 / 0.0635))


def test_event_loss_of_a_blank_map_is_about_one_whatever_the_motion() -> None:
    for size in (0.5, 5.0):
        measured = size * torch.randn(40, 40, generator=torch.Generator().manual_seed(0))
        assert float(event_loss(torch.zeros(40, 40), measured)) == pytest.approx(1, abs=0.01)


def test_event_loss_without_events_is_finite() -> None:
    torch.testing.assert_close(event_loss(torch.full((2, 2), 0.1), torch.zeros(2, 2)), torch.tensor(10.0))


def test_depth_loss_is_the_mean_absolute_error_of_measured_pixels() -> None:
    rendered = torch.tensor([[1.1, 2.0], [5.0, 2.7]], requires_grad=True)
    loss = depth_loss(rendered, torch.ones(2, 2), torch.tensor([[1.0, 2.0], [0.0, 3.0]]))
    torch.testing.assert_close(loss.detach(), torch.tensor(0.4 / 3))
    loss.backward()
    assert rendered.grad is not None
    assert rendered.grad[1, 0] == 0  # missing depth pulls at nothing


def test_depth_loss_does_not_count_what_is_transparent() -> None:
    alpha, measured = torch.tensor([[0.3, 0.99]]), torch.tensor([[2.0, 3.0]])
    surface = torch.tensor([[2.0, 3.1]])
    loss = depth_loss(alpha * surface, alpha, measured)
    torch.testing.assert_close(loss, torch.tensor(0.099 / 2))


def test_depth_loss_without_measured_pixels_is_zero_with_zero_gradient() -> None:
    rendered = torch.ones(2, 2, requires_grad=True)
    loss = depth_loss(rendered, torch.ones(2, 2), torch.zeros(2, 2))
    loss.backward()
    assert float(loss.detach()) == 0
    assert rendered.grad is not None
    assert (rendered.grad == 0).all()


def test_scale_loss_counts_only_what_exceeds_the_ratio() -> None:
    scales = torch.tensor([[0.01, 0.02, 0.05], [0.01, 0.01, 0.14]])  # 5 and 14 times as long as thick
    torch.testing.assert_close(scale_loss(scales.log(), max_ratio=10.0), torch.tensor(4.0 / 2))


def test_scale_loss_and_its_gradient_vanish_below_the_ratio() -> None:
    log_scales = torch.tensor([[0.01, 0.02, 0.09]]).log().requires_grad_()
    loss = scale_loss(log_scales, max_ratio=10.0)
    loss.backward()
    assert float(loss.detach()) == 0
    assert log_scales.grad is not None
    assert (log_scales.grad == 0).all()
