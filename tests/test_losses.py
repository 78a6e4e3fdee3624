"""Eq. 10 to 16 on numbers worked out by hand."""

import math

import pytest
import torch

from edslam_ti.losses import brightness_change, depth_loss, event_loss, scale_loss


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
    loss = depth_loss(rendered, torch.tensor([[1.0, 2.0], [0.0, 3.0]]))
    torch.testing.assert_close(loss.detach(), torch.tensor(0.4 / 3))
    loss.backward()
    assert rendered.grad is not None
    assert rendered.grad[1, 0] == 0  # missing depth pulls at nothing


def test_depth_loss_without_measured_pixels_is_zero_with_zero_gradient() -> None:
    rendered = torch.ones(2, 2, requires_grad=True)
    loss = depth_loss(rendered, torch.zeros(2, 2))
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
