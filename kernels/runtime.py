"""Starts Taichi, and checks the arrays that pass between torch and Taichi."""

import contextlib
import io
import os

import numpy as np
import torch

from edslam_ti.kernels import compiled_cache
from edslam_ti.kernels.engine import ENGINE, ti, with_home

_running: tuple[str, str, int] | None = None  # device, precision and threads of the engine
CHUNK = 512  # Taichi's CPU backend never splits a loop into pieces smaller than this


def init(arch: str = "cpu", precision: str = "f32", threads: int = 2, debug: bool | None = None) -> None:
    """Start Taichi on "cpu" or "cuda"; "f64" makes the same kernels run in double precision.

    `threads` is the number of CPU workers. `debug` checks array bounds (slow); None: the environment variable
    TI_DEBUG decides. Calling it again restarts Taichi. Raises RuntimeError when the device is missing; Taichi
    itself only warns.
    """
    if arch not in ("cpu", "cuda"):
        raise ValueError(f"arch: expected 'cpu' or 'cuda', got {arch!r}")
    if precision not in ("f32", "f64"):
        raise ValueError(f"precision: expected 'f32' or 'f64', got {precision!r}")
    if arch == "cuda" and not torch.cuda.is_available():
        raise RuntimeError("cuda: torch finds no CUDA device (or is a CPU build); use --device cpu")
    with contextlib.redirect_stdout(io.StringIO()):  # ti.init always prints its device
        _start(arch, precision, threads, debug)
    actual = ti.cfg.arch
    if (actual == ti.cuda) != (arch == "cuda"):
        raise RuntimeError(f"{arch}: Taichi started on {actual} instead; use --device cpu")
    global _running
    _running = (arch, precision, threads)


def ensure(arch: str = "cpu", threads: int = 2) -> None:
    """Start Taichi unless it runs like this already: a restart would compile every kernel again."""
    if _running != (arch, "f32", threads):
        init(arch, threads=threads)


def _start(arch: str, precision: str, threads: int, debug: bool | None) -> None:
    if debug is None and ENGINE != "taichi":  # Taichi reads the variable itself
        debug = os.environ.get("TI_DEBUG", "0") not in ("", "0")
    checks = {} if debug is None else {"debug": debug}
    with compiled_cache.opened(ti) as kept, with_home():
        ti.init(
            arch=ti.cuda if arch == "cuda" else ti.cpu,
            default_fp=ti.f64 if precision == "f64" else ti.f32,
            cpu_max_num_threads=threads,
            fast_math=False,
            log_level=ti.ERROR,
            **kept,
            **checks,
        )


def is_gpu() -> bool:
    """Return whether the kernels run on a GPU."""
    return ti.cfg.arch == ti.cuda


def synchronize() -> None:
    """Wait until the GPU has finished all that kernels and torch have launched."""
    ti.sync()
    torch.cuda.synchronize()


def workers() -> int:
    """Return the number of CPU threads that run kernels."""
    return int(ti.cfg.cpu_max_num_threads)


def float_dtype() -> torch.dtype:
    """Return the torch dtype of the kernels' floats."""
    return torch.float64 if ti.cfg.default_fp == ti.f64 else torch.float32


def check_shape(name: str, array: "torch.Tensor | np.ndarray", expected: tuple[int | None, ...]) -> None:
    """Raise ValueError unless the array has the expected shape (None = any size)."""
    shape = tuple(array.shape)
    if len(shape) != len(expected) or any(e is not None and e != s for s, e in zip(shape, expected)):
        wanted = "(" + ", ".join("*" if e is None else str(e) for e in expected) + ")"
        raise ValueError(f"{name}: expected shape {wanted}, got {shape}")


def plain(name: str, tensor: torch.Tensor) -> torch.Tensor:
    """Return the tensor detached, contiguous and in the kernels' float type, ready for a kernel.

    For a tensor that requires grad, Taichi would silently allocate a `.grad`.
    """
    if not tensor.is_floating_point():
        raise ValueError(f"{name}: expected a floating point tensor, got {tensor.dtype}")
    return tensor.detach().to(float_dtype()).contiguous()
