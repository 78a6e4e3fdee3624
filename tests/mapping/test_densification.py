"""Densification: which Gaussians become two, which go, and what pulls at them."""

import torch
from torch import Tensor

from edslam_ti.camera import Camera
from edslam_ti.config import MappingConfig
from edslam_ti.mapping.densification import FAINTEST, SHRINKING, Densifier
from edslam_ti.mapping.gaussians import GaussianMap

CAMERA = Camera(100, 80, 50.0, 50.0, 49.5, 39.5)
POSE = torch.eye(4)
SIZE = 2.0  # metres: Gaussians beyond 2 cm are split


def row_of(sizes: list[float], opacity: float = 0.8) -> GaussianMap:
    """Return Gaussians of these sizes (metres), 2 m before the camera."""
    gaussians = GaussianMap(MappingConfig())
    n = len(sizes)
    means = torch.tensor([[0.1 * k, 0.0, 2.0] for k in range(n)])
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1)
    gaussians.add(means, quats, torch.tensor(sizes)[:, None].repeat(1, 3), opacity, torch.full((n, 1), 0.5))
    return gaussians


def densifier(most: int = 100) -> Densifier:
    return Densifier(CAMERA, SIZE, min_gradient=1.0, most=most, seed=0)


def pull(by: Densifier, gaussians: GaussianMap, pixels: list[float]) -> None:
    """Let an image pull at every Gaussian by a gradient in pixels, sideways."""
    sideways = torch.tensor(pixels) * CAMERA.fx / 2.0  # of the mean in metres, 2 m away
    gradient = torch.stack([sideways, torch.zeros_like(sideways), torch.zeros_like(sideways)], 1)
    everyone = torch.arange(len(gaussians))
    at_centre = torch.tensor([[0.0, 0.0, 2.0]]).repeat(len(gaussians), 1)
    by.observe(len(gaussians), everyone, at_centre, gradient, POSE)


def sizes(gaussians: GaussianMap) -> Tensor:  # [N] metres
    return gaussians.raw["log_scales"].detach().exp().amax(1)


def test_small_ones_are_cloned_and_large_ones_split() -> None:
    gaussians, by = row_of([0.01, 0.01, 0.05]), densifier()
    threshold = 1.0 / (CAMERA.width / 2)  # pixels
    pull(by, gaussians, [2 * threshold, 0.5 * threshold, 2 * threshold])
    by.refine(gaussians)
    assert len(gaussians) == 5
    torch.testing.assert_close(sizes(gaussians)[:4], torch.tensor([0.01, 0.01, 0.05 / SHRINKING, 0.01]))
    torch.testing.assert_close(sizes(gaussians)[4], torch.tensor(0.05 / SHRINKING))
    means = gaussians.raw["means"].detach()
    assert torch.equal(means[3], means[0])  # the clone
    assert 0 < (means[4] - torch.tensor([0.2, 0.0, 2.0])).norm() < 4 * 0.05  # half of the split one
    assert not torch.equal(means[4], means[2])


def test_pull_along_the_ray_does_not_count() -> None:
    gaussians, by = row_of([0.01]), densifier()
    gradient = torch.tensor([[0.0, 0.0, 1e3]])
    by.observe(1, torch.tensor([0]), torch.tensor([[0.0, 0.0, 2.0]]), gradient, POSE)
    by.refine(gaussians)
    assert len(gaussians) == 1


def test_faint_and_huge_ones_go_and_a_full_map_does_not_grow() -> None:
    gaussians, by = row_of([0.01, 0.5, 0.01]), densifier(most=3)
    gaussians.raw["logit_opacities"].data[2] = -10.0
    pull(by, gaussians, [1.0, 1.0, 1.0])
    by.refine(gaussians)
    assert len(gaussians) == 1


def test_reset_makes_everything_faint() -> None:
    gaussians = row_of([0.01, 0.02])
    densifier().reset_opacities(gaussians)
    torch.testing.assert_close(
        gaussians.raw["logit_opacities"].detach().sigmoid(), torch.full((2,), 2 * FAINTEST)
    )
