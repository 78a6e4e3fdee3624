"""How Taichi is started: bounds checks on request, errors that say where, no silent change of device."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from edslam_ti import kernels
from edslam_ti.kernels.engine import ti

pytestmark = pytest.mark.slow


@ti.kernel
def _read(values: ti.types.ndarray(ti.i32, ndim=1), place: ti.i32, out: ti.types.ndarray(ti.i32, ndim=1)):
    for k in range(1):
        out[k] = values[place + k]


@ti.kernel
def _nameless(out: ti.types.ndarray(ti.i32, ndim=1)):
    for k in range(1):
        out[k] = nowhere_defined  # type: ignore[name-defined]  # noqa: F821


@pytest.fixture
def restarted(device: str) -> Iterator[None]:
    yield
    kernels.init(device, threads=2)


@pytest.mark.parametrize("by_argument", [True, False])
def test_debug_run_notices_an_index_out_of_bounds(
    by_argument: bool, device: str, restarted: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not by_argument:
        monkeypatch.setenv("TI_DEBUG", "1")
    kernels.init(device, threads=2, debug=True if by_argument else None)
    values, out = np.arange(4, dtype=np.int32), np.zeros(1, np.int32)
    _read(values, 3, out)
    assert out[0] == 3
    with pytest.raises(AssertionError, match="Out of bound access"):
        _read(values, 4, out)


def test_compile_error_of_a_kernel_names_the_line() -> None:
    with pytest.raises(NameError, match=r"test_runtime.py.*in _nameless[^$]*= nowhere_defined"):
        _nameless(np.zeros(1, np.int32))


def test_devices_that_are_unknown_or_not_there_are_refused() -> None:
    with pytest.raises(ValueError, match="arch: expected 'cpu' or 'cuda', got 'gpu'"):
        kernels.init("gpu")
    with pytest.raises(ValueError, match="precision: expected 'f32' or 'f64', got 'f16'"):
        kernels.init("cpu", precision="f16")
    if not torch.cuda.is_available():
        with pytest.raises(RuntimeError, match="use --device cpu"):
            kernels.init("cuda")


def test_a_process_leaves_its_compiled_kernels_to_the_next_one(tmp_path: Path) -> None:
    code = (
        "from edslam_ti import kernels; from edslam_ti.kernels.time_surface import compile_kernels; "
        "kernels.init(); compile_kernels()"
    )
    environment = os.environ | {"EDSLAM_CACHE": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, env=environment)
    (folder,) = (tmp_path / "kernels").iterdir()
    assert len([path for path in (folder / "compiled").rglob("*") if path.is_file()]) > 1
