"""Taichi is started once for the whole session; tests that need float64 kernels restart it and back."""

from collections.abc import Iterator
from pathlib import Path

import pytest

import edslam_ti  # noqa: F401  (sets the threading environment before torch loads)
import kernels

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session", autouse=True)
def taichi_cpu() -> None:
    kernels.init("cpu", threads=2)


@pytest.fixture
def double_precision() -> Iterator[None]:
    """Run the same kernels in float64, for gradcheck."""
    kernels.init("cpu", precision="f64", threads=2)
    yield
    kernels.init("cpu", threads=2)


@pytest.fixture
def shared_data() -> Path:
    """Real recordings kept beside the project, never in it."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"real data not found at {SHARED_DATA}")
    return SHARED_DATA
