"""How much may be computed, how many Gaussians fit, and which fade."""

import math

import torch

from edslam_ti.config import MappingConfig
from edslam_ti.mapping.budget import Budget, prune_faded, stride_for_budget
from edslam_ti.mapping.gaussians import GaussianMap


def test_fuller_maps_grow_by_coarser_gaussians() -> None:
    strides = [stride_for_budget(2, share) for share in (0.0, 0.5, 0.75, 0.9, 0.99, 1.0)]
    assert strides == [2, 2, 3, 5, 15, 64]


def test_budget_grows_with_the_data_and_counts_only_between_start_and_stop() -> None:
    now = [0.0]
    budget = Budget(2.0, clock=lambda: now[0])
    budget.start(10.0)
    now[0] = 1.0
    assert budget.left() == -1  # no data yet
    budget.stop()
    now[0] = 100.0
    budget.start(13.0)
    now[0] = 100.5
    assert budget.left() == 2 * 3 - 1.5
    assert budget.left(share=0.5) == 3 - 1.5
    budget.stop()
    assert budget.spent == 1.5


def test_without_a_limit_everything_is_left_and_time_is_still_counted() -> None:
    now = [0.0]
    budget = Budget(None, clock=lambda: now[0])
    budget.start(0.0)
    now[0] = 3.0
    assert budget.left() == math.inf
    budget.stop()
    assert budget.spent == 3


def test_only_gaussians_above_the_least_opacity_stay() -> None:
    gaussians = GaussianMap(MappingConfig())
    for k, opacity in enumerate((0.5, 0.04, 0.06)):
        mean = torch.tensor([[float(k), 0.0, 0.0]])
        upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        gaussians.add(mean, upright, torch.ones(1, 3), opacity, torch.full((1, 1), 0.5))
    prune_faded(gaussians, min_opacity=0.05)
    assert gaussians.raw["means"][:, 0].tolist() == [0, 2]
