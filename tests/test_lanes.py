"""Vectors of lanes: what kernels compute with them agrees with numpy."""

import numpy as np
import pytest
import taichi as ti
import torch

from kernels.lanes import LANES, exp, lanes, vector_instructions, zeros


@vector_instructions
@ti.kernel
def _exponentials(x: lanes(1), y: lanes(1), totals: ti.types.ndarray(ndim=1)):
    ti.loop_config(serialize=True)
    for i in range(x.shape[0]):
        y[i] = exp(x[i])
        totals[i] = ti.select(x[i] > 1, x[i], zeros()).sum()


def check(dtype: torch.dtype, tolerance: float) -> None:
    x = torch.linspace(0, float(np.log(256)), 100 * LANES, dtype=dtype).view(100, LANES)
    y, totals = torch.empty_like(x), torch.empty(100, dtype=dtype)
    _exponentials(x, y, totals)
    assert float((y / x.double().exp() - 1).abs().max()) < tolerance
    assert torch.allclose(totals, torch.where(x > 1, x, 0).sum(1))


def test_exp_and_masks_match_numpy_in_single_precision() -> None:
    check(torch.float32, 1.5e-6)  # eight times the rounding of exp(x / 8)


@pytest.mark.usefixtures("double_precision")
def test_exp_and_masks_match_numpy_in_double_precision() -> None:
    check(torch.float64, 1e-13)


def test_other_kernels_are_compiled_as_before() -> None:
    _exponentials(torch.zeros(1, LANES), torch.zeros(1, LANES), torch.zeros(1))
    assert ti.cfg.real_matrix_scalarize
    assert not ti.cfg.fast_math
