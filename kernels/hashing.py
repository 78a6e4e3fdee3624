"""Random numbers that are hashed from counters, so that they do not depend on the order of execution."""

import math

from edslam_ti.kernels.engine import ti


@ti.func
def hashed(value: ti.u32) -> ti.u32:
    """PCG output permutation: every input bit changes about half of the output bits."""
    state = value * ti.u32(747796405) + ti.u32(2891336453)
    word = ((state >> ((state >> ti.u32(28)) + ti.u32(4))) ^ state) * ti.u32(277803737)
    return (word >> ti.u32(22)) ^ word


@ti.func
def hashed_normal(seed: ti.u32, pixel: ti.u32, k: ti.u32) -> ti.f64:
    """Box-Muller from two hashed uniforms in (0, 1)."""
    first = hashed(hashed(hashed(seed) ^ pixel) ^ k)
    second = hashed(first ^ ti.u32(0x9E3779B9))
    u1 = (ti.cast(first, ti.f64) + ti.f64(0.5)) * ti.f64(2.0**-32)
    u2 = (ti.cast(second, ti.f64) + ti.f64(0.5)) * ti.f64(2.0**-32)
    return ti.sqrt(ti.f64(-2.0) * ti.log(u1)) * ti.cos(ti.f64(2.0 * math.pi) * u2)


@ti.func
def hashed_uniform(seed: ti.u32, pixel: ti.u32, k: ti.u32) -> ti.f64:
    """Return a hashed uniform number in (0, 1)."""
    word = hashed(hashed(hashed(seed) ^ pixel) ^ k)
    return (ti.cast(word, ti.f64) + ti.f64(0.5)) * ti.f64(2.0**-32)
