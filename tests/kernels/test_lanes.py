"""Vectors of lanes: what kernels compute with them agrees with numpy."""

import numpy as np
import pytest
import torch

from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.lanes import (
    LANES,
    SUMS,
    exp,
    join_columns,
    lanes,
    largest,
    log,
    split_columns,
    sums,
    sums_of,
    vector_instructions,
    zeros,
)


@vector_instructions
@ti.kernel
def _exponentials(x: lanes(1), y: lanes(1), totals: ti.types.ndarray(ndim=1)):
    ti.loop_config(serialize=True)
    for i in range(x.shape[0]):
        y[i] = exp(x[i])
        totals[i] = ti.select(x[i] > 1, x[i], zeros()).sum()


@vector_instructions
@ti.kernel
def _logarithms(x: lanes(1), y: lanes(1)):
    ti.loop_config(serialize=True)
    for i in range(x.shape[0]):
        y[i] = log(x[i])


@vector_instructions
@ti.kernel
def _reductions(x: lanes(1), totals: sums(1), most: ti.types.ndarray(ndim=1)):
    ti.loop_config(serialize=True)
    for i in range(totals.shape[0]):
        v = [x[i * SUMS + k] for k in range(SUMS)]
        totals[i] = sums_of(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7])
        most[i] = largest(x[i * SUMS])


@vector_instructions
@ti.kernel
def _columns(table: lanes(1), columns: lanes(2), again: lanes(1)):
    ti.loop_config(serialize=True)
    for group in range(columns.shape[1]):
        split_columns(table, group, columns, 0, 3)
        join_columns(columns, 0, 3, group, again)


def check(dtype: torch.dtype, tolerance: float) -> None:
    x = torch.linspace(0, float(np.log(256)), 100 * LANES, dtype=dtype).view(100, LANES)
    y, totals = torch.empty_like(x), torch.empty(100, dtype=dtype)
    _exponentials(x, y, totals)
    assert float((y / x.double().exp() - 1).abs().max()) < tolerance
    assert torch.allclose(totals, torch.where(x > 1, x, 0).sum(1))


def test_exp_and_masks_match_numpy_in_single_precision() -> None:
    check(torch.float32, 1.5e-6)  # eight times the rounding of exp(x / 8)


@pytest.mark.slow
@pytest.mark.usefixtures("double_precision")
def test_exp_and_masks_match_numpy_in_double_precision() -> None:
    check(torch.float64, 1e-13)


def check_log(dtype: torch.dtype, tolerance: float) -> None:
    x = torch.logspace(-3, 3, 100 * LANES, dtype=dtype).view(100, LANES)
    y = torch.empty_like(x)
    _logarithms(x, y)
    assert float((y - x.double().log()).abs().max()) < tolerance


def test_log_matches_numpy_in_single_precision() -> None:
    check_log(torch.float32, 3e-6)  # sixteen times the rounding of log(x^(1/16))


@pytest.mark.slow
@pytest.mark.usefixtures("double_precision")
def test_log_matches_numpy_in_double_precision() -> None:
    check_log(torch.float64, 1e-13)


def test_sums_and_largest_of_lanes_match_torch() -> None:
    x = torch.rand(5 * SUMS, LANES, generator=torch.Generator().manual_seed(0))
    totals, most = torch.empty(5, SUMS), torch.empty(5)
    _reductions(x, totals, most)
    torch.testing.assert_close(totals, x.sum(1).view(5, SUMS))
    assert torch.equal(most, x[::SUMS].amax(1))


def test_columns_of_a_table_become_lanes_and_a_table_again() -> None:
    table = torch.arange(3.0 * 4 * LANES).view(4 * LANES, 3)
    columns, again = torch.empty(3, 4, LANES), torch.empty(4 * 3, LANES)
    _columns(table.view(-1, LANES), columns, again)
    assert torch.equal(columns.view(3, -1), table.T)
    assert torch.equal(again.view_as(table), table)


def test_other_kernels_are_compiled_as_before() -> None:
    _exponentials(torch.zeros(1, LANES), torch.zeros(1, LANES), torch.zeros(1))
    assert ti.cfg.real_matrix_scalarize
    assert not ti.cfg.fast_math
