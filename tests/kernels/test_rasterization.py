"""Gaussian rasterizer: twin, gradcheck and properties (Eq. 6-8)."""

import functools

import pytest
import torch

from edslam_ti import kernels
from edslam_ti.kernels import reference
from edslam_ti.kernels.rasterization import rasterize

INTRINSICS = (40.0, 42.0, 19.3, 14.6)
SIZE = (40, 30)


def make_scene(
    n: int, seed: int, dtype: torch.dtype = torch.float32, channels: int = 1
) -> list[torch.Tensor]:
    """Gaussians in front of a slightly turned camera, some of them outside the image or behind it."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)

    means = torch.stack([uniform(-1.2, 1.2, n), uniform(-0.9, 0.9, n), uniform(-0.3, 4.0, n)], -1)
    quats = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    scales = uniform(0.02, 0.15, n, 3)
    opacities = uniform(0.1, 0.95, n)
    colors = uniform(0.0, 1.0, n, channels)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = reference.rotation_matrices(torch.tensor([[1.0, 0.05, -0.08, 0.03]]).double())[0]
    pose[:3, 3] = torch.tensor([0.05, -0.02, 0.6])
    return [x.to(dtype) for x in (means, quats, scales, opacities, colors, pose)]


@pytest.mark.slow
@pytest.mark.parametrize("pixelwise", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
def test_rendering_and_all_gradients_match_the_torch_twin(channels: int, pixelwise: bool) -> None:
    inputs = make_scene(200, seed=1, channels=channels)
    kernel_inputs = [x.clone().requires_grad_() for x in inputs]
    twin_inputs = [x.double().requires_grad_() for x in inputs]
    ours = rasterize(*kernel_inputs, INTRINSICS, SIZE, pixelwise=pixelwise)
    twin = reference.rasterize(*twin_inputs, INTRINSICS, SIZE)
    # Two correct float32 / float64 rasterizers differ at single pixels by the 1/255 cut-off.
    for name, tolerance in (("image", 1e-5), ("depth", 5e-5), ("alpha", 1e-5)):
        difference = (getattr(ours, name) - getattr(twin, name)).abs()
        assert difference.mean() < tolerance, name
        assert difference.max() < 2e-2, name
    assert (ours.visible == twin.visible).float().mean() > 0.99
    assert (ours.dominant == twin.dominant).float().mean() > 0.99
    cotangents = [torch.randn(x.shape, generator=torch.Generator().manual_seed(k), dtype=torch.float64)
                  for k, x in enumerate((twin.image, twin.depth, twin.alpha))]  # fmt: skip
    ours_loss = sum(
        (getattr(ours, k) * c.float()).sum() for k, c in zip(("image", "depth", "alpha"), cotangents)
    )
    twin_loss = sum((getattr(twin, k) * c).sum() for k, c in zip(("image", "depth", "alpha"), cotangents))
    names = ("means", "quats", "scales", "opacities", "colors", "pose")
    for name, a, b in zip(
        names, torch.autograd.grad(ours_loss, kernel_inputs), torch.autograd.grad(twin_loss, twin_inputs)
    ):
        b = b[:3] if name == "pose" else b
        a = a[:3] if name == "pose" else a
        assert (a - b).norm() / b.norm() < 1e-4, name  # float32 against float64


@pytest.mark.slow
@pytest.mark.parametrize("pixelwise", [False, True])
@pytest.mark.usefixtures("double_precision")
def test_gradcheck_in_double_precision(pixelwise: bool) -> None:
    means, quats, scales, opacities, colors, pose = make_scene(5, seed=3, dtype=torch.float64)
    means[:, 2] += 1.5  # all in front: no culling boundary within the finite difference
    scales *= 3  # smooth over several pixels
    inputs = [x.requires_grad_() for x in (means, quats, scales, opacities, colors)]

    def render(*arguments: torch.Tensor) -> tuple[torch.Tensor, ...]:
        result = rasterize(*arguments, (8.0, 8.0, 3.5, 2.5), (8, 6), pixelwise=pixelwise)
        return result.image, result.depth, result.alpha

    def render_from(translation: torch.Tensor) -> tuple[torch.Tensor, ...]:
        moved = pose + torch.nn.functional.pad(translation.view(3, 4), (0, 0, 0, 1))
        return render(*[x.detach() for x in inputs], moved)

    # The 1/255 cut-off is a step of 0.004 c at single pixels; the seed keeps finite differences off it.
    atomics = {"nondet_tol": 1e-12} if pixelwise else {}  # sums in any order
    check = functools.partial(torch.autograd.gradcheck, eps=1e-7, atol=1e-5, rtol=1e-4, **atomics)
    assert check(lambda *x: render(*x, pose), inputs)
    zero = torch.zeros(12, dtype=torch.float64, requires_grad=True)
    assert check(render_from, (zero,))


@pytest.mark.slow
def test_a_gaussian_peaks_at_the_pixel_it_was_seeded_from() -> None:
    x, y, z = 12, 20, 2.0
    fx, fy, cx, cy = INTRINSICS
    mean = torch.tensor([[(x - cx) / fx * z, (y - cy) / fy * z, z]])
    view = rasterize(mean, torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.03), torch.tensor([0.9]),
                     torch.ones(1, 1), torch.eye(4), INTRINSICS, SIZE)  # fmt: skip
    peak = int(view.image[..., 0].argmax())
    assert divmod(peak, SIZE[0]) == (y, x)
    assert float(view.alpha[y, x]) == pytest.approx(0.9, abs=1e-4)
    assert float(view.depth[y, x] / view.alpha[y, x]) == pytest.approx(z, rel=1e-5)


def test_a_nearer_opaque_gaussian_hides_a_farther_one() -> None:
    means = torch.tensor([[0.0, 0, 3.0], [0.0, 0, 1.5]])
    quats, scales = torch.tensor([[1.0, 0, 0, 0]] * 2), torch.tensor([[0.02] * 3, [0.2] * 3])
    opacities, colors = torch.tensor([0.99, 0.99]), torch.tensor([[1.0], [0.0]])
    view = rasterize(means, quats, scales, opacities, colors, torch.eye(4), INTRINSICS, SIZE)
    assert float(view.image[15, 19, 0]) < 0.02
    assert view.visible.tolist() == [False, True]


def gradients_with(inputs: list[torch.Tensor], **options: int | bool) -> list[torch.Tensor]:
    view = rasterize(*inputs, INTRINSICS, SIZE, **options)
    loss = view.image.sum() + view.depth.sin().sum() + view.alpha.square().sum()
    return [view.image.detach(), view.depth.detach(), *torch.autograd.grad(loss, inputs)]


@pytest.mark.slow
def test_repeated_runs_are_identical() -> None:
    inputs = [x.requires_grad_() for x in make_scene(300, seed=5)]
    for a, b in zip(gradients_with(inputs), gradients_with(inputs), strict=True):
        assert torch.equal(a, b)


@pytest.mark.slow
@pytest.mark.parametrize("pixelwise", [False, True])
@pytest.mark.parametrize("tile", [4, 8, 64])
def test_size_of_tiles_does_not_matter(tile: int, pixelwise: bool) -> None:
    inputs = [x.requires_grad_() for x in make_scene(300, seed=5)]
    inputs[2].data[:5] = 1.0  # some reach over more rows of blocks than are kept exactly
    expected = gradients_with(inputs)
    for a, b in zip(gradients_with(inputs, tile=tile, pixelwise=pixelwise), expected, strict=True):
        assert float((a - b).norm()) <= 1e-5 * float(b.norm())


@pytest.mark.slow
def test_number_of_threads_does_not_change_the_result(device: str) -> None:
    inputs = [x.requires_grad_() for x in make_scene(300, seed=6)]

    def image_and_gradients() -> list[torch.Tensor]:
        view = rasterize(*inputs, INTRINSICS, SIZE)
        return [view.image, *torch.autograd.grad(view.image.sin().sum() + view.depth.sum(), inputs)]

    two = image_and_gradients()
    kernels.init(device, threads=1)
    one = image_and_gradients()
    kernels.init(device, threads=2)
    assert all(torch.equal(a, b) for a, b in zip(one, two))


@pytest.mark.slow
@pytest.mark.parametrize("pixelwise", [False, True])
def test_gaussians_of_equal_depth_are_drawn_in_their_order(pixelwise: bool) -> None:
    means = torch.tensor([[0.0, 0, 2.0]] * 3)
    colors = torch.tensor([[0.2], [0.9], [0.5]])
    quats, scales = torch.tensor([[1.0, 0, 0, 0]] * 3), torch.full((3, 3), 0.2)
    opacities = torch.full((3,), 0.5)
    camera = (torch.eye(4), (40, 40, 20, 15), SIZE)
    view = rasterize(means, quats, scales, opacities, colors, *camera, pixelwise=pixelwise)
    assert float(view.image[15, 20, 0]) == pytest.approx(0.5 * 0.2 + 0.25 * 0.9 + 0.125 * 0.5, abs=1e-6)


def test_a_tile_that_cannot_be_cut_into_blocks_is_refused() -> None:
    with pytest.raises(ValueError, match="tile: expected a multiple of 4"):
        rasterize(*make_scene(4, seed=8), INTRINSICS, SIZE, tile=18)


@pytest.mark.slow
@pytest.mark.parametrize("pixelwise", [False, True])
@pytest.mark.parametrize("count", [0, 4])
def test_an_empty_view_is_black_and_has_zero_gradients(count: int, pixelwise: bool) -> None:
    inputs = make_scene(count, seed=7)
    inputs[0][:, 2] = -5.0
    inputs = [x.requires_grad_() for x in inputs]
    view = rasterize(*inputs, INTRINSICS, SIZE, pixelwise=pixelwise)
    assert float(view.alpha.abs().max()) == 0
    gradients = torch.autograd.grad(view.image.sum() + view.depth.sum(), inputs)
    assert not any(bool(g.any()) for g in gradients)


def test_wrong_shapes_are_named() -> None:
    means, quats, *rest = make_scene(4, seed=8)
    with pytest.raises(ValueError, match=r"quats: expected shape \(4, 4\), got \(3, 4\)"):
        rasterize(means, quats[:3], *rest, INTRINSICS, SIZE)
