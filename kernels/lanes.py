"""Sixteen values at a time: what a kernel needs to use a CPU's vector registers.

Taichi normally takes vectors apart into scalars, and LLVM does not put them together again. A kernel
under `@vector_instructions` is compiled without that step: arithmetic on a `ti.Vector` of LANES numbers
becomes vector instructions, comparisons become masks for `ti.select`, and `fast_math` lets multiply and
add fuse (it also assumes that nothing is NaN). Of the operations on vectors, Taichi 1.7 then cannot
compile negation, casts, `abs`, `exp` and `log`; CPU memory must be aligned as torch's is.
"""

import functools
from collections.abc import Callable

import numpy as np
import taichi as ti
import torch

from kernels.runtime import float_dtype

LANES = 16


def vector_instructions(kernel: Callable) -> Callable:
    """Return the kernel, compiled with fast_math and, on a CPU, so that vectors stay whole."""

    @functools.wraps(kernel)
    def launch(*arguments: object) -> None:
        ti.cfg.real_matrix_scalarize = ti.cfg.arch == ti.cuda
        ti.cfg.fast_math = True
        try:
            kernel(*arguments)
        finally:
            ti.cfg.real_matrix_scalarize = True
            ti.cfg.fast_math = False

    return launch


_Lanes = ti.types.vector(LANES)  # of the kernels' float type, whatever it is
_IntegerLanes = ti.types.vector(LANES, ti.i32)


def lanes(ndim: int) -> ti.types.ndarray:
    """Return the type of an array argument [..., LANES] of floats with `ndim` leading dimensions."""
    return ti.types.ndarray(_Lanes, ndim=ndim)


def integer_lanes(ndim: int) -> ti.types.ndarray:
    """Return the type of an array argument [..., LANES] of int32 with `ndim` leading dimensions."""
    return ti.types.ndarray(_IntegerLanes, ndim=ndim)


def exp_coefficients() -> list[float]:
    """Return the polynomial in x through exp(x / 8) at the Chebyshev nodes of [0, ln 256]."""
    degree = 11 if float_dtype() == torch.float64 else 5  # relative error 1e-16 or 1e-7
    series = np.polynomial.Chebyshev.interpolate(lambda x: np.exp(x / 8), degree, domain=[0, np.log(256)])
    return series.convert(kind=np.polynomial.Polynomial).coef.tolist()


@ti.func
def zeros():
    return ti.Vector([0.0 for _ in range(LANES)])


@ti.func
def exp(x):
    """exp(x) = exp(x / 8)^8 for 0 <= x <= ln 256; elsewhere meaningless."""
    coefficients = ti.static(exp_coefficients())
    value = x * coefficients[-1] + coefficients[-2]
    for k in ti.static(range(len(coefficients) - 3, -1, -1)):
        value = value * x + coefficients[k]
    value *= value
    value *= value
    return value * value


@ti.func
def largest(v):
    """Largest of the lanes, by halves: `max()` takes them one after the other and looks out for NaN."""
    parts = [v[lane] for lane in range(LANES)]
    for step in ti.static(range(LANES.bit_length() - 1)):
        half = ti.static(LANES >> (step + 1))
        for lane in ti.static(range(half)):
            parts[lane] = ti.select(parts[lane] > parts[lane + half], parts[lane], parts[lane + half])
    return parts[0]
