"""Taichi is started once for the whole session; tests that need float64 kernels restart it and back."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import edslam_ti  # noqa: F401  (sets the threading environment before torch loads)
from edslam_ti import kernels
from edslam_ti.datasets import EventDepthSequence, Sample, SampledSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session", autouse=True)
def taichi_cpu() -> None:
    kernels.init("cpu", threads=2)
    torch.set_num_threads(1)  # a few thousand numbers are done before a second thread has woken up


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


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the tiny room on disk; copy it before changing anything."""
    from sequences import record_tiny_room

    return record_tiny_room(tmp_path_factory.mktemp("recordings") / "tiny")


@pytest.fixture(scope="session")
def tiny_sequence(tiny_folder: Path) -> EventDepthSequence:
    return EventReplicaSequence(tiny_folder)


@pytest.fixture(scope="session")
def tiny_samples(tiny_sequence: EventDepthSequence) -> list[Sample]:
    """Its samples, 50 ms apart, each with depth, image and true pose."""
    return list(SampledSequence(tiny_sequence, start=0.0, duration=None, max_interval=0.1))
