"""What may show in a view, against its twin."""

import pytest
import torch
from torch import Tensor

from edslam_ti.kernels import reference
from edslam_ti.kernels.culling import drawable

INTRINSICS, SIZE = (40.0, 42.0, 31.5, 23.5), (64, 48)


def gaussians(n: int = 2000) -> tuple[Tensor, Tensor]:
    """Return means and log scales all around the camera, from small to larger than the image."""
    generator = torch.Generator().manual_seed(0)
    means = 3 * torch.randn(n, 3, generator=generator)
    return means, 1.5 * torch.randn(n, 3, generator=generator) - 3


def test_marked_are_those_whose_largest_ball_reaches_the_image() -> None:
    means, log_scales = gaussians()
    pose = torch.eye(4)
    pose[:3, :3] = torch.linalg.qr(means[:3])[0]
    pose[:3, 3] = torch.tensor([0.2, -0.1, 0.5])
    chosen = drawable(means, log_scales, pose, INTRINSICS, SIZE)
    assert 100 < len(chosen) < 1000
    assert torch.equal(chosen, reference.drawable(means, log_scales, pose, INTRINSICS, SIZE))


def test_nothing_is_drawable_of_an_empty_map_or_behind_the_camera() -> None:
    means, log_scales = gaussians()
    assert len(drawable(means[:0], log_scales[:0], torch.eye(4), INTRINSICS, SIZE)) == 0
    behind = torch.cat([means[:, :2], -means[:, 2:].abs()], 1)
    assert len(drawable(behind, log_scales, torch.eye(4), INTRINSICS, SIZE)) == 0


def test_tables_of_other_lengths_are_refused() -> None:
    means, log_scales = gaussians()
    with pytest.raises(ValueError, match="log_scales: expected shape"):
        drawable(means, log_scales[:5], torch.eye(4), INTRINSICS, SIZE)
