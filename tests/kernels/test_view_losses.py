"""Fused comparisons of views: value and all gradients are those of rendering and torch."""

from collections.abc import Callable

import pytest
import torch

from edslam_ti import kernels
from edslam_ti.kernels import reference
from edslam_ti.kernels.rasterization import rasterize
from edslam_ti.kernels.view_losses import compare_change, compare_view

INTRINSICS = (40.0, 42.0, 19.3, 14.6)
SIZE = (41, 30)  # not a multiple of the blocks
BACKGROUND, EPSILON = 0.3, 1 / 255


def make_map(n: int, dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    """Gaussians in front of the origin, as leaves."""
    generator = torch.Generator().manual_seed(4)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)

    means = torch.stack([uniform(-1.2, 1.2, n), uniform(-0.9, 0.9, n), uniform(0.5, 4.0, n)], -1)
    values = [means, torch.randn(n, 4, generator=generator, dtype=torch.float64), uniform(0.02, 0.15, n, 3),
              uniform(0.1, 0.995, n), uniform(0.02, 0.95, n, 1)]  # fmt: skip
    return [x.to(dtype).requires_grad_() for x in values]


def make_poses(dtype: torch.dtype = torch.float32) -> torch.Tensor:  # [2, 4, 4]
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    turns = torch.tensor([[1.0, 0.03, -0.02, 0.01], [1.0, -0.01, 0.04, -0.02]], dtype=torch.float64)
    poses[:, :3, :3] = reference.rotation_matrices(turns)
    poses[:, :3, 3] = torch.tensor([[0.02, -0.01, 0.1], [-0.03, 0.02, 0.05]])
    return poses.to(dtype).requires_grad_()


def images() -> tuple[torch.Tensor, torch.Tensor]:
    """A target of log brightness, and a depth image with holes."""
    generator = torch.Generator().manual_seed(5)
    shape = (SIZE[1], SIZE[0])
    depth = 1 + torch.rand(shape, generator=generator)
    depth[torch.rand(shape, generator=generator) < 0.3] = 0
    return 0.3 * torch.randn(shape, generator=generator) - 1, depth


def assert_same(ours: list[torch.Tensor], theirs: list[torch.Tensor], tolerance: float) -> None:
    names = ("loss", "means", "quats", "scales", "opacities", "colors", "poses")
    for name, a, b in zip(names, ours, theirs, strict=True):
        assert float((a - b).norm() / b.norm()) < tolerance, name


def with_gradients(loss: torch.Tensor, inputs: list[torch.Tensor]) -> list[torch.Tensor]:
    return [loss.detach(), *torch.autograd.grad(loss, inputs)]


Renderer = Callable[..., reference.Rasterization]


def change_twin(
    render: Renderer, inputs: list[torch.Tensor], measured: torch.Tensor, scale: float
) -> torch.Tensor:
    *gaussians, poses = inputs
    start, end = (render(*gaussians, pose, INTRINSICS, SIZE) for pose in poses)
    return scale * reference.compare_change(start, end, measured, BACKGROUND, EPSILON)


def view_twin(
    render: Renderer, inputs: list[torch.Tensor], target: torch.Tensor, depth: torch.Tensor
) -> torch.Tensor:
    *gaussians, poses = inputs
    view = render(*gaussians, poses[0], INTRINSICS, SIZE)
    squares, errors = reference.compare_view(view, target, depth, BACKGROUND, EPSILON)
    return 0.7 * squares + 0.2 * errors


def change(inputs: list[torch.Tensor], measured: torch.Tensor, scale: float, **options: int) -> torch.Tensor:
    return compare_change(*inputs, INTRINSICS, SIZE, measured, BACKGROUND, EPSILON, scale, **options).loss


@pytest.mark.slow
@pytest.mark.parametrize("pixelwise", [False, True])
def test_change_between_two_views_matches_rendering_them(pixelwise: bool) -> None:
    inputs, (measured, _) = [*make_map(300), make_poses()], images()
    ours = with_gradients(3 * change(inputs, measured, 0.5, pixelwise=pixelwise), inputs)
    assert_same(ours, with_gradients(change_twin(rasterize, inputs, measured, 1.5), inputs), 2e-5)


@pytest.mark.parametrize("pixelwise", [False, True])
def test_one_view_with_depth_matches_rendering_it(pixelwise: bool) -> None:
    inputs, (target, depth) = [*make_map(300), make_poses()], images()
    result = compare_view(
        *inputs[:-1], inputs[-1][0], INTRINSICS, SIZE, target, depth, BACKGROUND, EPSILON, 0.7, 0.2,
        pixelwise=pixelwise,
    )  # fmt: skip
    theirs = with_gradients(view_twin(rasterize, inputs, target, depth), inputs)
    assert_same(with_gradients(result.loss, inputs), theirs, 2e-5)
    view = rasterize(*inputs[:-1], inputs[-1][0], INTRINSICS, SIZE)
    depth_error = 0.2 * (view.depth - view.alpha * depth).abs()[depth > 0]
    squares = 0.7 * result.difference.square().sum()
    assert float(result.loss.detach()) == pytest.approx(
        float((squares + depth_error.sum()).detach()), rel=1e-5
    )


@pytest.mark.slow
@pytest.mark.usefixtures("double_precision")
def test_both_match_the_torch_twin_in_double_precision() -> None:
    inputs = [*make_map(100, torch.float64), make_poses(torch.float64)]
    target, depth = (image.double() for image in images())
    ours = with_gradients(change(inputs, target, 0.5), inputs)
    assert_same(ours, with_gradients(change_twin(reference.rasterize, inputs, target, 0.5), inputs), 1e-9)
    view = compare_view(
        *inputs[:-1], inputs[-1][0], INTRINSICS, SIZE, target, depth, BACKGROUND, EPSILON, 0.7, 0.2
    )
    theirs = with_gradients(view_twin(reference.rasterize, inputs, target, depth), inputs)
    assert_same(with_gradients(view.loss, inputs), theirs, 1e-9)


@pytest.mark.slow
def test_repeated_runs_are_identical_and_tiles_and_threads_do_not_matter(device: str) -> None:
    inputs, (measured, _) = [*make_map(300), make_poses()], images()

    def run(**options: int) -> list[torch.Tensor]:
        return with_gradients(change(inputs, measured, 0.5, **options), inputs)

    first = run()
    assert all(torch.equal(a, b) for a, b in zip(first, run(), strict=True))
    assert_same(run(tile=8), first, 1e-5)
    kernels.init(device, threads=1)
    try:
        assert all(torch.equal(a, b) for a, b in zip(first, run(), strict=True))
    finally:
        kernels.init(device, threads=2)


@pytest.mark.slow
def test_a_view_of_nothing_has_zero_gradients() -> None:
    inputs, (target, depth) = [*make_map(20), make_poses()], images()
    behind = [(inputs[0].detach() - torch.tensor([0.0, 0.0, 10.0])).requires_grad_(), *inputs[1:]]
    result = compare_view(
        *behind[:-1], behind[-1][0], INTRINSICS, SIZE, target, depth, BACKGROUND, EPSILON, 0.7, 0.0
    )
    gradients = torch.autograd.grad(result.loss, behind)
    assert all(float(gradient.abs().max()) == 0 for gradient in gradients)


def test_images_of_another_size_are_refused() -> None:
    inputs, (measured, _) = [*make_map(4), make_poses()], images()
    with pytest.raises(ValueError, match=r"target: expected shape \(30, 41\), got \(41, 30\)"):
        change(inputs, measured.T, 0.5)
