"""Views of a map: background and depth."""

import numpy as np
import torch

from edslam_ti.camera import Camera
from edslam_ti.config import MappingConfig
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.rendering import drawable, render, render_view

CAMERA = Camera(64, 48, 40.0, 40.0, 31.5, 23.5)


def wall(depth: float, spacing: float = 0.05, brightness: float | None = None) -> GaussianMap:
    """Return a wall of Gaussians across the view at `depth` metres; random brightness unless given."""
    gaussians = GaussianMap(MappingConfig())
    side = torch.arange(-2.0, 2.0, spacing)
    x, y = torch.meshgrid(side, side, indexing="ij")
    means = torch.stack([x.ravel(), y.ravel(), torch.full((x.numel(),), depth)], -1)
    scales = torch.full((len(means), 3), 0.6 * spacing)
    scales[:, 2] = 0.001
    facing = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(len(means), 1)
    generator = torch.Generator().manual_seed(0)
    colors = (
        torch.rand(len(means), 1, generator=generator)
        if brightness is None
        else torch.full((len(means), 1), brightness)
    )
    gaussians.add(means, facing, scales, 0.95, colors)
    return gaussians


def test_background_fills_an_empty_view() -> None:
    view = render_view(GaussianMap(MappingConfig()), CAMERA, np.eye(4), background=0.3)
    np.testing.assert_allclose(view.intensity, 0.3, rtol=1e-6)
    assert (view.depth == 0).all()
    assert (view.alpha == 0).all()


def test_background_has_the_weight_one_minus_alpha() -> None:
    gaussians = wall(2.0, brightness=0.8).activated()
    dark, bright = (render(gaussians, CAMERA, torch.eye(4), background=b) for b in (0.0, 1.0))
    torch.testing.assert_close(bright.intensity - dark.intensity, 1 - dark.alpha, rtol=0, atol=1e-6)


def test_wall_is_seen_at_its_depth_and_brightness() -> None:
    view = render_view(wall(2.0, brightness=0.8), CAMERA, np.eye(4), background=0.8)
    np.testing.assert_allclose(view.intensity, 0.8, rtol=1e-4)
    np.testing.assert_allclose(view.depth, 2.0, rtol=1e-4)
    assert view.alpha.min() > 0.9


def test_gaussians_that_cannot_be_drawn_change_no_pixel() -> None:
    gaussians = wall(2.0)
    gaussians.raw["log_scales"].data[::7] += 1.5  # some reach into the image from far outside
    pose = torch.eye(4)
    pose[0, 3], pose[2, 3] = 1.2, 1.0
    chosen = drawable(gaussians, CAMERA, pose)
    whole, part = (render(g.activated(), CAMERA, pose, 0.5) for g in (gaussians, gaussians.subset(chosen)))
    assert torch.equal(part.intensity, whole.intensity)
    assert torch.equal(part.depth, whole.depth)
    assert torch.equal(part.visible, whole.visible[chosen])
    assert int(whole.visible.sum()) == int(part.visible.sum())
    assert len(chosen) < 0.25 * len(gaussians)


def test_camera_that_steps_back_sees_the_wall_farther_away() -> None:
    T_world_camera = np.eye(4)
    T_world_camera[2, 3] = -0.5
    view = render_view(wall(2.0), CAMERA, T_world_camera, background=0.5)
    np.testing.assert_allclose(view.depth[10:-10, 10:-10], 2.5, rtol=1e-4)


def test_median_depth_is_that_of_a_surface_even_at_an_outline() -> None:
    both = wall(2.0)
    both.raw["means"].data[:, 0] -= 2.0  # its outline in the middle of the view
    behind = wall(3.0).activated()
    both.add(
        behind.means.detach(), behind.quats.detach(), behind.scales.detach(), 0.95, behind.colors.detach()
    )
    T = np.eye(4)
    depth = render_view(both, CAMERA, T, background=0.5).depth
    expected = render(both.activated(), CAMERA, torch.from_numpy(T), 0.5).expected_depth

    def between(depth: np.ndarray) -> int:
        return int(((depth > 2.1) & (depth < 2.9)).sum())

    assert between(depth) == 0
    assert between(expected.detach().numpy()) >= CAMERA.height  # a skirt
    assert depth[24, 16] == 2.0
    assert depth[24, 48] == 3.0


def test_gradients_reach_the_map_and_the_pose() -> None:
    gaussians = wall(2.0, spacing=0.2)
    pose = torch.eye(4, dtype=torch.float64, requires_grad=True)
    view = render(gaussians.activated(), CAMERA, pose, background=0.5)
    (view.intensity.square().mean() + view.depth.mean()).backward()
    assert pose.grad is not None
    assert float(pose.grad[:3].abs().min(0).values.max()) > 0
    for name in ("means", "log_scales", "logit_opacities", "logit_colors"):
        gradient = gaussians.raw[name].grad
        assert gradient is not None
        assert torch.isfinite(gradient).all()
        assert float(gradient.abs().max()) > 0, name
