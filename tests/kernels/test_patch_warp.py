"""Patches, warp, sampling and normal equations (Eq. 2-5)."""

import numpy as np
import pytest
import torch
from patches import bilinear_samples, normal_equations, warped_pixels

from edslam_ti import kernels
from edslam_ti.geometry import adjoint, inverse, se3_exp
from edslam_ti.kernels import reference
from edslam_ti.kernels.patch_warp import (
    Alignment,
    Direction,
    ResidualModel,
    extract_patches,
)

INTRINSICS = (50.0, 48.0, 31.5, 23.5)
SHAPE = (48, 64)
MODEL = ResidualModel()


def make_view(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A smooth surface and a smooth depth with a hole."""
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float64)
    phase = seed * 0.7
    surface = 0.5 + 0.25 * np.sin(u / 4 + phase) + 0.2 * np.cos(v / 3 - u / 9)
    depth = 2 + 0.3 * np.sin(u / 15) + 0.2 * np.cos(v / 11)
    depth[5:9, 40:50] = 0
    return surface.astype(np.float32), depth.astype(np.float32)


def make_centres(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([rng.integers(0, SHAPE[1], n), rng.integers(0, SHAPE[0], n)], -1).astype(np.int32)


def make_motion(size: float, seed: int = 0) -> np.ndarray:
    return se3_exp(
        size * torch.randn(6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    ).numpy()


def test_identity_warp_returns_the_patch() -> None:
    surface, depth = make_view(0)
    patches = extract_patches(surface, depth, make_centres(20, 1), 5)
    warped = warped_pixels(patches.pixels, np.eye(4), INTRINSICS)
    usable = patches.pixels[:, 2] > 0
    assert np.allclose(warped[usable, :2], patches.pixels[usable, :2], atol=1e-4)
    values, inside = bilinear_samples(surface, warped)
    interior = usable & inside
    assert np.allclose(values[interior], patches.values[interior], atol=1e-4)


def test_patch_outside_the_image_is_invalid() -> None:
    surface, depth = make_view(0)
    patches = extract_patches(surface, depth, np.array([[-20, 10]], np.int32), 5)
    assert not patches.pixels[:, 2].any()
    result = normal_equations(patches, surface, depth, np.eye(4), INTRINSICS, MODEL)
    assert result.num_usable == 0
    assert result.cost == 0


def test_warp_and_sampling_match_the_twin() -> None:
    surface, depth = make_view(0)
    patches = extract_patches(surface, depth, make_centres(30, 2), 5)
    usable = patches.pixels[:, 2] > 0
    T = make_motion(0.03)
    warped = warped_pixels(patches.pixels, T, INTRINSICS)
    twin = reference.warp_pixels(
        torch.from_numpy(patches.pixels[usable]).double(), torch.from_numpy(T), INTRINSICS
    )
    assert np.allclose(warped[usable], twin.numpy(), atol=1e-4)
    values, inside = bilinear_samples(surface, warped)
    good = usable & inside
    expected = reference.sample_bilinear(torch.from_numpy(surface), torch.from_numpy(warped[good]))
    assert np.allclose(values[good], expected.numpy(), atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("is_inverse", [False, True])
def test_normal_equations_match_autograd_of_the_twin(is_inverse: bool) -> None:
    surface_a, depth_a = make_view(0)
    surface_b, depth_b = make_view(1)
    patches = extract_patches(surface_a, depth_a, make_centres(40, 3), 5)
    T = torch.from_numpy(make_motion(0.02, seed=4))  # the transform whose update is sought
    ours = normal_equations(
        patches, surface_b, depth_b, (inverse(T) if is_inverse else T).numpy(), INTRINSICS, MODEL, is_inverse
    )

    def residuals(xi: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        updated = se3_exp(xi) @ T
        T_b_a = inverse(updated) if is_inverse else updated
        arrays = [torch.from_numpy(x).double() for x in (patches.pixels, patches.values, surface_b, depth_b)]
        return reference.alignment_residuals(*arrays, T_b_a, INTRINSICS, MODEL)

    zero = torch.zeros(6, dtype=torch.float64)
    r = residuals(zero)
    jacobians = torch.autograd.functional.jacobian(residuals, zero)
    H, g, cost = torch.zeros(6, 6).double(), torch.zeros(6).double(), 0.0
    for r_k, J, weight in zip(r, jacobians, (1.0, MODEL.depth_weight)):
        w = weight * torch.clamp(MODEL.huber_threshold / r_k.abs().clamp_min(1e-12), max=1.0)
        H += J.T @ (w[:, None] * J)
        g += J.T @ (w * r_k)
        cost += weight * float(reference.huber(r_k, MODEL.huber_threshold).sum())
    assert (ours.num_surface, ours.num_depth) == (len(r[0]), len(r[1]))
    # float32 residuals at depth sigma of millimetres against float64
    assert ours.cost == pytest.approx(cost, rel=1e-3)
    assert np.linalg.norm(ours.H - H.numpy()) / np.linalg.norm(H) < 1e-3
    assert np.linalg.norm(ours.g - g.numpy()) / np.linalg.norm(g) < 5e-3


@pytest.mark.slow
def test_compositional_jacobians_match_autograd_of_the_template() -> None:
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float64)
    surface, depth = 0.5 + 0.25 * np.sin(u / 4) + 0.2 * np.cos(v / 3 - u / 9), 2 + 0.3 * np.sin(u / 15)
    centres = 8 + make_centres(40, 3) % (np.array([48, 32], np.int32))  # inside the image, wherever they move
    patches, T = extract_patches(surface, depth, centres, 5), make_motion(0.005, seed=4)
    direction = Direction(patches.points(INTRINSICS, (surface, depth)), 0, MODEL)
    (ours,) = Alignment([direction], np.stack([surface, depth], -1)[None], INTRINSICS).linearise([T])
    arrays = [torch.from_numpy(x) for x in (patches.pixels, patches.values, surface, depth)]
    pixels, column, row = arrays[0], arrays[0][:, 0].long(), arrays[0][:, 1].long()

    def templates(xi: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        warped = reference.warp_pixels(pixels, se3_exp(xi), INTRINSICS)
        moved = warped[:, :2] - pixels[:, :2]

        def change(image: torch.Tensor) -> torch.Tensor:
            along_y, along_x = (slope[row, column] for slope in torch.gradient(image))
            return along_x * moved[:, 0] + along_y * moved[:, 1]

        return change(arrays[2]), warped[:, 2] - change(arrays[3])

    residuals = reference.alignment_residuals(*arrays, torch.from_numpy(T), INTRINSICS, MODEL)
    assert len(residuals[0]) == len(residuals[1]) == len(pixels) == ours.num_depth
    jacobians = torch.autograd.functional.jacobian(templates, torch.zeros(6, dtype=torch.float64))
    z = reference.warp_pixels(pixels, torch.from_numpy(T), INTRINSICS)[:, 2:]
    sigmas = (MODEL.surface_sigma, MODEL.depth_sigma + MODEL.depth_sigma_2 * z**2)
    H, g = torch.zeros(6, 6).double(), torch.zeros(6).double()
    for r, J, sigma, share in zip(residuals, jacobians, sigmas, (1.0, MODEL.depth_weight)):
        w = share * torch.clamp(MODEL.huber_threshold / r.abs().clamp_min(1e-12), max=1.0)
        H += (J / sigma).T @ (w[:, None] * J / sigma)
        g += (J / sigma).T @ (w * r)
    # float32 residuals at depth sigma of millimetres against float64
    assert np.linalg.norm(ours.H - H.numpy()) / np.linalg.norm(H) < 1e-3
    assert np.linalg.norm(ours.g - g.numpy()) / np.linalg.norm(g) < 5e-3


def test_compositional_jacobians_are_the_additive_ones_where_views_align() -> None:
    surface, depth = make_view(0)
    centres = 8 + make_centres(80, 8) % np.array([48, 32], np.int32)
    patches, view = extract_patches(surface, depth, centres, 5), np.stack([surface, depth], -1)[None]
    additive, compositional = (
        Alignment([Direction(patches.points(INTRINSICS, template), 0, MODEL)], view, INTRINSICS).linearise(
            [np.eye(4)]
        )[0]
        for template in (None, (surface, depth))
    )
    assert compositional.num_surface == additive.num_surface
    # central differences, and none beside holes in depth, against those between neighbours
    assert np.linalg.norm(compositional.H - additive.H) / np.linalg.norm(additive.H) < 0.1


def test_depth_that_disagrees_by_more_than_tau_d_is_discarded() -> None:
    surface, depth = make_view(0)
    patches = extract_patches(surface, depth, make_centres(40, 5), 5)
    far = np.where(depth > 0, depth + 0.2, 0).astype(np.float32)
    agreeing = normal_equations(patches, surface, depth, np.eye(4), INTRINSICS, MODEL)
    disagreeing = normal_equations(patches, surface, far, np.eye(4), INTRINSICS, MODEL)
    assert agreeing.num_depth > 300
    assert disagreeing.num_depth == 0
    assert disagreeing.num_surface < 0.1 * agreeing.num_surface  # only those without depth to check


def test_missing_depth_in_the_other_view_keeps_the_surface_residual() -> None:
    surface, depth = make_view(0)
    patches = extract_patches(surface, depth, make_centres(40, 6), 5)
    result = normal_equations(patches, surface, np.zeros_like(depth), np.eye(4), INTRINSICS, MODEL)
    assert result.num_depth == 0
    assert result.num_surface > 300


def make_alignment(sizes: tuple[int, int]) -> Alignment:
    """Patches of two views, each against the image of the other."""
    views = [make_view(0), make_view(1)]
    directions = [
        Direction(extract_patches(*view, make_centres(n, 7), 5).points(INTRINSICS), 1 - k, MODEL)
        for k, (view, n) in enumerate(zip(views, sizes))
    ]
    return Alignment(directions, np.stack([np.stack(view, -1) for view in views]), INTRINSICS)


def test_directions_linearised_together_are_those_linearised_alone() -> None:
    views, sizes, T = [make_view(0), make_view(1)], (30, 41), make_motion(0.02)
    together = make_alignment(sizes).linearise([T, np.linalg.inv(T)])
    for k, pose in enumerate((T, np.linalg.inv(T))):
        patches = extract_patches(*views[k], make_centres(sizes[k], 7), 5)
        alone = normal_equations(patches, *views[1 - k], pose, INTRINSICS, MODEL)
        assert np.array_equal(together[k].H, alone.H)
        assert np.array_equal(together[k].g, alone.g)
        assert (together[k].cost, together[k].num_usable) == (alone.cost, alone.num_usable)


@pytest.mark.slow
def test_normal_equations_have_the_same_bits_for_any_number_of_threads(device: str) -> None:
    T = make_motion(0.02)
    systems = []
    for threads in (1, 3, 2):
        kernels.init(device, threads=threads)
        systems.append(make_alignment((900, 300)).linearise([T, np.linalg.inv(T)]))
    for others in systems[1:]:
        for ours, other in zip(systems[0], others):
            assert np.array_equal(ours.H, other.H)
            assert np.array_equal(ours.g, other.g)


def test_patches_without_a_pixel_give_an_empty_system() -> None:
    (system,) = make_alignment((0, 0)).linearise([np.eye(4)] * 2)[:1]
    assert (system.num_usable, system.cost) == (0, 0)
    assert not system.H.any()


def test_view_that_is_not_there_is_refused() -> None:
    surface, depth = make_view(0)
    points = extract_patches(surface, depth, make_centres(3, 0), 5).points(INTRINSICS)
    with pytest.raises(ValueError, match="view: expected 0 to 0, got 1"):
        Alignment([Direction(points, 1, MODEL)], np.stack([surface, depth], -1)[None], INTRINSICS)


def test_adjoint_carries_a_twist_to_the_other_side() -> None:
    generator = torch.Generator().manual_seed(0)
    T = se3_exp(torch.randn(6, generator=generator, dtype=torch.float64))
    twist = torch.randn(6, generator=generator, dtype=torch.float64)
    moved = se3_exp(torch.from_numpy(adjoint(T.numpy())) @ twist)
    np.testing.assert_allclose((moved @ T).numpy(), (T @ se3_exp(twist)).numpy(), atol=1e-12)
