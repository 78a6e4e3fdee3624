"""Vectors of sixteen values, with which kernels use a CPU's vector registers.

Taichi normally splits vectors into scalars, and LLVM does not join them again. A kernel under
`@vector_instructions` is compiled without that step: arithmetic on a `ti.Vector` of LANES numbers becomes
vector instructions, comparisons become masks for `ti.select`, and a vector of other vectors' lanes becomes a
shuffle. Of the operations on vectors, Taichi 1.7 then cannot compile negation, casts, `abs`, `rsqrt`, `exp`
and `log`; CPU memory must be aligned as torch's is. `ti.min` and `ti.max` do not propagate NaN: if one
operand is NaN they return the other, which takes additional instructions. Use `ti.select` in inner loops.
"""

import functools
import threading
from collections.abc import Callable

import numpy as np
import torch

from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.runtime import float_dtype

LANES = 16
SUMS = 8  # number of vectors whose lanes `sums_of` adds at once
_configuration = threading.RLock()  # guards the engine's settings


def vector_instructions(kernel: Callable) -> Callable:
    """Return the kernel, compiled with fast_math and, on a CPU, with whole vectors.

    Both are settings of the whole engine, changed during a launch. A lock keeps two threads from launching
    such kernels at once; another thread must not launch other kernels meanwhile.
    """

    @functools.wraps(kernel)
    def launch(*arguments: object) -> None:
        with _configuration:
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
_Sums = ti.types.vector(SUMS)


def lanes(ndim: int) -> ti.types.ndarray:
    """Return the type of an array argument [..., LANES] of floats with `ndim` leading dimensions."""
    return ti.types.ndarray(_Lanes, ndim=ndim)


def integer_lanes(ndim: int) -> ti.types.ndarray:
    """Return the type of an array argument [..., LANES] of int32 with `ndim` leading dimensions."""
    return ti.types.ndarray(_IntegerLanes, ndim=ndim)


def sums(ndim: int) -> ti.types.ndarray:
    """Return the type of an array argument [..., SUMS] of floats with `ndim` leading dimensions."""
    return ti.types.ndarray(_Sums, ndim=ndim)


def exp_coefficients() -> list[float]:
    """Return the polynomial in x through exp(x / 8) at the Chebyshev nodes of [0, ln 256]."""
    degree = 11 if float_dtype() == torch.float64 else 5  # relative error 1e-16 or 1e-7
    series = np.polynomial.Chebyshev.interpolate(lambda x: np.exp(x / 8), degree, domain=[0, np.log(256)])
    return series.convert(kind=np.polynomial.Polynomial).coef.tolist()


def log_coefficients() -> list[float]:
    """Return 2, 2/3, 2/5, ...: the series of log((1 + y) / (1 - y)) in y, y^3, y^5, ..."""
    terms = 12 if float_dtype() == torch.float64 else 5
    return [2 / (2 * k + 1) for k in range(terms)]


@ti.func
def zeros():
    return ti.Vector([0.0 for _ in range(LANES)])


@ti.func
def exp(x):
    """exp(x) = exp(x / 8)^8 for 0 <= x <= ln 256; undefined elsewhere."""
    coefficients = ti.static(exp_coefficients())
    value = x * coefficients[-1] + coefficients[-2]
    for k in ti.static(range(len(coefficients) - 3, -1, -1)):
        value = value * x + coefficients[k]
    value *= value
    value *= value
    return value * value


@ti.func
def log(x):
    """log(x) = 16 log(x^(1/16)) for 1e-3 <= x <= 1e3; less accurate farther from 1."""
    root = ti.sqrt(ti.sqrt(ti.sqrt(ti.sqrt(x))))
    y = (root - 1.0) / (root + 1.0)  # at most 0.22
    coefficients = ti.static(log_coefficients())
    series = y * y * coefficients[-1] + coefficients[-2]
    for k in ti.static(range(len(coefficients) - 3, -1, -1)):
        series = series * (y * y) + coefficients[k]
    return 16.0 * y * series


@ti.func
def largest(v):
    """Largest of the lanes, by halves: `max()` would go through them in sequence and test for NaN."""
    parts = [v[lane] for lane in range(LANES)]
    for step in ti.static(range(LANES.bit_length() - 1)):
        half = ti.static(LANES >> (step + 1))
        for lane in ti.static(range(half)):
            parts[lane] = ti.select(parts[lane] > parts[lane + half], parts[lane], parts[lane + half])
    return parts[0]


@ti.func
def split_columns(
    source: ti.template(),  # [G * width] lanes of a table [G * LANES, width]
    group,
    target: ti.template(),  # [>= row + width, G] lanes
    row: ti.template(),
    width: ti.template(),
):
    """Write columns of LANES rows of a table as rows of `target`."""
    numbers = [source[group * width + k // LANES][k % LANES] for k in range(width * LANES)]
    for column in ti.static(range(width)):
        target[row + column, group] = ti.Vector([numbers[lane * width + column] for lane in range(LANES)])


@ti.func
def join_columns(
    source: ti.template(), row: ti.template(), width: ti.template(), group, target: ti.template()
):
    """Undo `split_columns`."""
    columns = [source[row + column, group] for column in range(width)]
    for k in ti.static(range(width)):
        target[group * width + k] = ti.Vector(
            [columns[(k * LANES + lane) % width][(k * LANES + lane) // width] for lane in range(LANES)]
        )


@ti.func
def _folded(a, b):
    """The sum of the two halves of a, followed by that of b."""
    low = ti.Vector([a[k] for k in range(8)] + [b[k] for k in range(8)])
    high = ti.Vector([a[8 + k] for k in range(8)] + [b[8 + k] for k in range(8)])
    return low + high


@ti.func
def _quarters_added(a, b):
    """For two results of `_folded`, the sum of the halves of each half."""
    low = ti.Vector([v[8 * h + k] for v in (a, b) for h in range(2) for k in range(4)])
    high = ti.Vector([v[8 * h + 4 + k] for v in (a, b) for h in range(2) for k in range(4)])
    return low + high


@ti.func
def _eighths_added(a, b):
    low = ti.Vector([v[4 * q + k] for v in (a, b) for q in range(4) for k in range(2)])
    high = ti.Vector([v[4 * q + 2 + k] for v in (a, b) for q in range(4) for k in range(2)])
    return low + high


@ti.func
def sums_of(a, b, c, d, e, f, g, h):
    """Sums of the lanes of SUMS vectors as one vector, in a tenth of the steps of SUMS single sums."""
    ab, cd, ef, gh = _folded(a, b), _folded(c, d), _folded(e, f), _folded(g, h)
    pairs = _eighths_added(_quarters_added(ab, cd), _quarters_added(ef, gh))
    return ti.Vector([pairs[2 * k] for k in range(SUMS)]) + ti.Vector([pairs[2 * k + 1] for k in range(SUMS)])
