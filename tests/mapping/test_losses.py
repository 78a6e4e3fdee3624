"""Eq. 12, 14, 15 and 16 beside the same in torch, and on numbers worked out by hand."""

import pytest
import torch

from edslam_ti.camera import Camera
from edslam_ti.config import MappingConfig
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.losses import BRIGHTNESS_VARIANCE, map_loss, scale_loss, view_loss
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


def depth_loss(rendered: torch.Tensor, alpha: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    """Return Eq. 15 in torch: [H, W] metres weighted by alpha, [H, W], [H, W] metres with 0 = missing."""
    return (rendered - alpha * measured).abs()[measured > 0].mean()


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


def test_depth_loss_of_transparent_gaussians_counts_where_they_are_not_how_much_light_they_stop() -> None:
    pose, dark = torch.eye(4, dtype=torch.float64), torch.zeros(30, 40)
    faint = GaussianMap(MappingConfig())
    at = torch.tensor([[0.0, 0.0, 2.0]])
    faint.add(at, torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 3), 0.3), 0.3, torch.full((1, 1), 0.5))

    def loss(depth: float) -> float:
        measured = torch.full((30, 40), depth)
        view = view_loss(faint.activated(), CAMERA, pose, dark, measured, BACKGROUND, EPSILON, (0.0, 1.0))
        return float(view.loss.detach())

    assert loss(2.0) == pytest.approx(0, abs=1e-6)
    alpha = render(faint.activated(), CAMERA, pose, BACKGROUND).alpha.detach()
    assert loss(2.1) == pytest.approx(0.1 * float(alpha.mean()), rel=1e-4)


def test_depth_image_without_measured_pixels_pulls_at_nothing() -> None:
    gaussians, pose, zeros = scattered_map(), torch.eye(4), torch.zeros(30, 40)
    view = view_loss(gaussians.activated(), CAMERA, pose, zeros, zeros, BACKGROUND, EPSILON, (0.0, 1.0))
    view.loss.backward()
    assert float(view.loss.detach()) == 0
    pull = gaussians.raw["means"].grad
    assert pull is not None
    assert (pull == 0).all()


def test_map_loss_is_eq_16_with_brightness_in_units_of_its_variance() -> None:
    gaussians, pose = scattered_map(), torch.eye(4, dtype=torch.float64)
    target, depth = torch.full((30, 40), -0.8), torch.full((30, 40), 1.5)
    config = MappingConfig(
        event_weight=0.7, depth_weight=0.05, scale_weight=0.25, max_scale_ratio=1.5, background=BACKGROUND
    )
    loss = map_loss(gaussians, CAMERA, pose, target, depth, config)
    view = render(gaussians.activated(), CAMERA, pose, BACKGROUND)
    difference = torch.log(view.intensity + config.log_epsilon) - target
    event = difference.square().mean() / BRIGHTNESS_VARIANCE
    expected = 0.7 * event + 0.05 * depth_loss(view.depth, view.alpha, depth)
    expected = expected + 0.25 * scale_loss(gaussians.raw["log_scales"], 1.5)
    torch.testing.assert_close(loss.total.detach(), expected.detach(), rtol=1e-4, atol=0)
    assert loss.event == pytest.approx(float(event.detach()), rel=1e-4)
    torch.testing.assert_close(torch.from_numpy(loss.difference), difference.detach(), atol=1e-5, rtol=1e-5)


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
