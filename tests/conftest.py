"""The engine of the kernels is started once for the whole session; float64 tests restart it and back."""

from edslam_ti.cold_start import load_kernels

load_kernels()  # as commands do, before anything below loads numpy or torch

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from edslam_ti import kernels
from edslam_ti.datasets import EventDepthSequence, Sample, SampledSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence

# Real recordings, kept beside the project and never in it
DATA = Path(os.environ.get("EDSLAM_DATA") or Path(__file__).parents[2] / "shared" / "data")


# A shell ignores Ctrl-C for what it starts in the background; tests of signals need what a terminal gives.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", choices=("cpu", "cuda"), default="cpu", help="where tests/kernels run")
    parser.addoption("--kills", type=int, default=1, help="how often tests/test_checkpoint.py kills runs")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark tests that need real recordings; with --device cuda only tests of kernels are run."""
    for item in items:
        if "shared_data" in getattr(item, "fixturenames", ()):
            item.add_marker("data")
    if config.getoption("device") == "cuda":
        if not torch.cuda.is_available():
            pytest.exit("skipped: --device cuda, but torch finds no CUDA device", returncode=0)
        on_device = [item for item in items if Path(__file__).parent / "kernels" in item.path.parents]
        config.hook.pytest_deselected(items=[item for item in items if item not in on_device])
        items[:] = on_device
        for item in items:
            item.add_marker("gpu")


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> str:
    """Return where kernels run."""
    chosen: str = request.config.getoption("device")
    return chosen


@pytest.fixture(scope="session")
def kills(request: pytest.FixtureRequest) -> int:
    """Return how many times runs are killed."""
    return int(request.config.getoption("kills"))


@pytest.fixture(scope="session", autouse=True)
def started_kernels(device: str) -> None:
    kernels.init(device, threads=2)
    torch.set_num_threads(1)  # a few thousand numbers are done before a second thread has woken up


@pytest.fixture
def double_precision(device: str) -> Iterator[None]:
    """Run the same kernels in float64, for gradcheck."""
    kernels.init(device, precision="f64", threads=2)
    yield
    kernels.init(device, threads=2)


@pytest.fixture
def shared_data() -> Path:
    """Return the folder of real recordings; EDSLAM_DATA names another than ../shared/data."""
    if not DATA.is_dir():
        pytest.skip(f"real data not found at {DATA}; EDSLAM_DATA names its folder")
    return DATA


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record the tiny room on disk; copy the folder before changing anything."""
    from sequences import record_tiny_room

    return record_tiny_room(tmp_path_factory.mktemp("recordings") / "tiny")


@pytest.fixture(scope="session")
def tiny_sequence(tiny_folder: Path) -> EventDepthSequence:
    return EventReplicaSequence(tiny_folder)


@pytest.fixture(scope="session")
def tiny_samples(tiny_sequence: EventDepthSequence) -> list[Sample]:
    """Return its samples, 50 ms apart, each with depth, image and true pose."""
    return list(SampledSequence(tiny_sequence, start=0.0, duration=None, max_interval=0.1))
