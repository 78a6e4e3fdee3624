"""The Gaussian map: what is added is shown, and Adam's memory follows every Gaussian."""

import numpy as np
import pytest
import torch
from torch import Tensor

from edslam_ti.config import MappingConfig
from edslam_ti.geometry import se3_exp
from edslam_ti.mapping.gaussians import PARAMETERS, GaussianMap

CONFIG = MappingConfig()
RATES = {
    "means": CONFIG.means_rate,
    "quats": CONFIG.quats_rate,
    "log_scales": CONFIG.scales_rate,
    "logit_opacities": CONFIG.opacities_rate,
    "logit_colors": CONFIG.colors_rate,
}


def upright(count: int) -> Tensor:  # [count, 4] wxyz
    """Return quaternions that turn nothing."""
    return torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1)


def add(gaussians: GaussianMap, count: int, seed: int = 0, opacity: float = 0.8) -> Tensor:
    """Add random Gaussians within a metre; returns their colours [count, 1]."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator) - 0.5
    scales = 0.01 + 0.02 * torch.rand(count, 3, generator=generator)
    colors = 0.1 + 0.8 * torch.rand(count, 1, generator=generator)
    gaussians.add(means, upright(len(means)), scales, opacity, colors)
    return colors


def push(gaussians: GaussianMap, gradients: dict[str, Tensor]) -> None:
    """Take a step along given gradients of the raw parameters."""
    sum((gaussians.raw[name] * gradients[name]).sum() for name in PARAMETERS).backward()
    gaussians.step()


class AdamByHand:
    """Kingma and Ba 2015, one moment pair per number; all count the same steps."""

    def __init__(self) -> None:
        self.steps = 0
        self.moments: dict[str, list[Tensor]] = {}

    def step(self, values: dict[str, Tensor], gradients: dict[str, Tensor]) -> dict[str, Tensor]:
        self.steps += 1
        result = {}
        for name, value in values.items():
            m, v = self.moments[name]
            m[:] = 0.9 * m + 0.1 * gradients[name]
            v[:] = 0.999 * v + 0.001 * gradients[name] ** 2
            m_hat, v_hat = m / (1 - 0.9**self.steps), v / (1 - 0.999**self.steps)
            result[name] = value - RATES[name] * m_hat / (v_hat.sqrt() + 1e-15)
        return result


def test_added_gaussians_have_the_given_parameters() -> None:
    gaussians = GaussianMap(CONFIG)
    assert len(gaussians) == 0
    means, scales = torch.tensor([[0.1, 0.2, 1.0]]), torch.tensor([[0.01, 0.02, 0.03]])
    gaussians.add(means, upright(1), scales, 0.7, torch.tensor([[0.3]]))
    shown = gaussians.activated()
    torch.testing.assert_close(shown.means.detach(), means)
    torch.testing.assert_close(shown.scales.detach(), scales)
    torch.testing.assert_close(shown.opacities.detach(), torch.tensor([0.7]))
    torch.testing.assert_close(shown.colors.detach(), torch.tensor([[0.3]]))
    torch.testing.assert_close(shown.quats.detach(), torch.tensor([[1.0, 0, 0, 0]]))


def test_moments_follow_their_gaussians_through_adding_and_keeping() -> None:
    gaussians, by_hand = GaussianMap(CONFIG), AdamByHand()
    generator = torch.Generator().manual_seed(1)
    add(gaussians, 4)
    by_hand.moments = {n: [torch.zeros_like(v.detach()) for _ in "mv"] for n, v in gaussians.raw.items()}

    def step() -> None:
        before = {name: value.detach().clone() for name, value in gaussians.raw.items()}
        gradients = {n: torch.randn(v.shape, generator=generator) for n, v in before.items()}
        expected = by_hand.step(before, gradients)
        push(gaussians, gradients)
        for name in PARAMETERS:
            torch.testing.assert_close(gaussians.raw[name].detach(), expected[name], msg=name)

    step()
    step()
    add(gaussians, 3, seed=2)
    for name, pair in by_hand.moments.items():
        width = gaussians.raw[name].shape[1:]
        by_hand.moments[name] = [torch.cat([moment, torch.zeros(3, *width)]) for moment in pair]
    step()
    mask = torch.tensor([True, False, True, True, False, True, False])
    gaussians.keep(mask)
    by_hand.moments = {n: [moment[mask] for moment in pair] for n, pair in by_hand.moments.items()}
    assert len(gaussians) == 4
    step()
    step()


def test_a_subset_is_optimised_like_the_whole_map_and_the_rest_is_unchanged() -> None:
    whole, same = GaussianMap(CONFIG), GaussianMap(CONFIG)
    for gaussians in (whole, same):
        add(gaussians, 60)
    before = {name: value.detach().clone() for name, value in whole.raw.items()}
    chosen = torch.arange(0, 60, 2)
    for _ in range(3):
        part = whole.subset(chosen)
        for optimised, indices in ((part, torch.arange(30)), (same, chosen)):
            shown = optimised.activated()
            (shown.colors[indices].square().sum() + shown.scales[indices].prod(-1).sum()).backward()
            optimised.step()
        whole.update_from(part, chosen)
    torch.testing.assert_close(whole.activated().colors, same.activated().colors)
    for name, value in whole.raw.items():
        torch.testing.assert_close(value[chosen], same.raw[name][chosen], msg=name)
        assert torch.equal(value[1::2], before[name][1::2]), name


def test_gaussians_at_assumed_depth_can_be_left_out() -> None:
    gaussians = GaussianMap(CONFIG)
    add(gaussians, 3)
    assert gaussians.measured() is gaussians
    tables = torch.full((2, 3), 7.0), upright(2), torch.full((2, 3), 0.1)
    gaussians.add(*tables, 0.5, torch.full((2, 1), 0.5), 1, torch.tensor([False, True]))
    gaussians.keep(torch.tensor([True, False, True, True, True]))
    gaussians.clone(torch.tensor([2]))  # the assumed one
    assert len(gaussians) == 5
    measured = gaussians.measured()
    assert len(measured) == 3
    torch.testing.assert_close(measured.raw["means"], gaussians.raw["means"][[0, 1, 3]])


def test_gaussians_follow_the_frame_they_are_from() -> None:
    gaussians = GaussianMap(CONFIG)
    for frame in (3, 8):
        gaussians.add(
            torch.tensor([[1.0, 0.0, 0.0]]),
            upright(1),
            torch.full((1, 3), 0.1),
            0.5,
            torch.full((1, 1), 0.5),
            frame,
        )
    quarter = se3_exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))  # about z
    quarter[2, 3] = 0.5
    gaussians.move_with_frames({8: quarter, 99: quarter})
    expected = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.5]])
    torch.testing.assert_close(gaussians.raw["means"].detach(), expected)
    half = 0.5**0.5
    torch.testing.assert_close(gaussians.raw["quats"].detach()[1], torch.tensor([half, 0.0, 0.0, half]))


def test_kept_gaussians_keep_their_brightness_after_cells_have_moved() -> None:
    gaussians = GaussianMap(CONFIG)
    add(gaussians, 50)
    gaussians.activated().colors.sum().backward()
    gaussians.step()
    before = gaussians.activated()
    mask = torch.arange(50) % 3 == 0
    gaussians.keep(mask)
    after = gaussians.activated()
    torch.testing.assert_close(after.colors, before.colors[mask], rtol=0, atol=0)
    torch.testing.assert_close(after.means, before.means[mask], rtol=0, atol=0)


def test_new_gaussians_have_their_colour_although_cells_are_shared() -> None:
    gaussians = GaussianMap(CONFIG)
    add(gaussians, 200)
    for _ in range(5):
        gaussians.activated().colors.sum().backward()
        gaussians.step()
    old = gaussians.activated().colors.detach()
    colors = add(gaussians, 200, seed=3)  # in the same cells
    shown = gaussians.activated().colors.detach()
    torch.testing.assert_close(shown[200:], colors)
    torch.testing.assert_close(shown[:200], old, rtol=0, atol=0)


def test_a_cell_moves_the_neighbours_of_the_gaussian_that_pulls() -> None:
    gaussians = GaussianMap(CONFIG)
    near, far = [0.01, 0.01, 0.01], [0.03, 0.03, 0.03]
    gaussians.add(
        torch.tensor([near, far, [9.0, 9, 9]]),
        upright(3),
        torch.full((3, 3), 0.01),
        0.8,
        torch.full((3, 1), 0.5),
    )
    gaussians.activated().colors[0, 0].backward()
    gaussians.step()
    pulled, neighbour, stranger = gaussians.activated().colors.detach()[:, 0]
    assert pulled < neighbour < 0.5
    assert stranger == 0.5


def test_two_maps_with_the_same_gradients_stay_equal_to_the_last_bit() -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)  # parallel sums in any order would differ in the last bits
    try:
        results = []
        for _ in range(3):
            gaussians = GaussianMap(CONFIG)
            add(gaussians, 20_000)
            weights = torch.randn(20_000, 1, generator=torch.Generator().manual_seed(4))
            for _ in range(2):
                shown = gaussians.activated()
                ((shown.colors * weights).sum() + (shown.scales.prod(-1) * weights[:, 0]).sum()).backward()
                gaussians.step()
            results.append(gaussians.activated())
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert torch.equal(other.colors, results[0].colors)
        assert torch.equal(other.scales, results[0].scales)


@pytest.mark.parametrize("grows_between", [False, True])
def test_decayed_rates_shorten_the_steps_also_after_adding(grows_between: bool) -> None:
    gaussians = GaussianMap(CONFIG)
    add(gaussians, 2)
    gaussians.decay_rates(0.5)
    gaussians.decay_rates(0.1)  # of the configured rate, not of the last
    if grows_between:
        add(gaussians, 2, seed=1)
    before = gaussians.raw["means"].detach().clone()
    push(gaussians, {name: torch.ones_like(value) for name, value in gaussians.raw.items()})
    # Adam's first step is as long as its rate.
    torch.testing.assert_close(
        before - gaussians.raw["means"].detach(),
        torch.full_like(before, 0.1 * CONFIG.means_rate),
        rtol=1e-3,
        atol=0,
    )


def test_extreme_brightness_stays_finite() -> None:
    gaussians = GaussianMap(CONFIG)
    gaussians.add(torch.zeros(2, 3), upright(2), torch.full((2, 3), 0.01), 0.5, torch.tensor([[0.0], [1.0]]))
    assert torch.isfinite(gaussians.raw["logit_colors"]).all()
    shown = gaussians.activated().colors.detach()
    torch.testing.assert_close(shown, torch.tensor([[0.0], [1.0]]), atol=1 / 255, rtol=0)  # a grey level
