"""The paper's event loss (Eq. 10 to 12), with which the benchmark's mapping step is timed, by hand."""

import math

import pytest
import torch

from edslam_ti.experiments.steps import brightness_change, event_loss


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
