"""A session that is fed gives what `edslam slam` gives, to the bit, however the data come in."""

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from sequences import record_tiny_room, settings

from edslam_ti import pipeline
from edslam_ti.config import Config
from edslam_ti.datasets import SampledSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.session import Session
from edslam_ti.trajectory import Trajectory

pytestmark = pytest.mark.slow

FEW = {"iterations": 1, "final_iterations": 4}


@pytest.fixture(scope="module", autouse=True)
def taichi_is_started_once() -> Any:
    """Runs start Taichi themselves, which recompiles every kernel; here it runs already."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline.kernels, "init", lambda *arguments, **options: None)
        yield


@pytest.fixture(scope="module")
def slow_depth(tmp_path_factory: pytest.TempPathFactory) -> EventReplicaSequence:
    """The tiny room with depth every 100 ms, so that frames without depth lie in between."""
    folder = tmp_path_factory.mktemp("recordings") / "slow"
    return EventReplicaSequence(record_tiny_room(folder, depth_rate=10.0, duration=0.6))


def config_with(**differences: Any) -> Config:
    mapping = FEW | differences.pop("mapping", {})
    return settings(contrast_threshold=0.1, mapping=mapping, **differences)


def run_of(sequence: EventReplicaSequence, config: Config) -> Trajectory:
    """Return the refined path that `edslam slam` finds."""
    folder = sequence._folder
    places = {"scene": folder.name, "dataset": "event_replica", "data_dir": folder.parent}
    paths: list[Trajectory] = []

    def keep(run: Any, *arguments: Any) -> None:
        paths.append(run.slam.trajectory.snapshot())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "save", keep)
        patch.setattr(pipeline, "point_latest_to", lambda path: "")
        out = folder.parent / "results"
        pipeline.run(config.updated({**places, "out": str(out)}), Console(file=io.StringIO()))
    return paths[0]


@pytest.fixture(scope="module")
def expected(slow_depth: EventReplicaSequence) -> Trajectory:
    return run_of(slow_depth, config_with())


def session_for(sequence: EventReplicaSequence, config: Config | None = None, **options: Any) -> Session:
    first = SampledSequence(sequence, 0.0, None, 0.05)[0]
    return Session(sequence.camera, config or config_with(), initial_pose=first.T_world_camera, **options)


def assert_same(path: Trajectory, other: Trajectory) -> None:
    np.testing.assert_array_equal(path.timestamps, other.timestamps)
    np.testing.assert_array_equal(path.poses, other.poses)


def all_events(sequence: EventReplicaSequence) -> list[np.ndarray]:
    events = sequence.events(-np.inf, np.inf)
    return [events.x, events.y, events.t, events.polarity]


def in_chunks(sequence: EventReplicaSequence, largest: int, seed: int = 0) -> Iterator[tuple[Any, ...]]:
    """Yield (time, x, y, t, p) of chunks and (time, depth) of images as they would come in."""
    random, columns = np.random.default_rng(seed), all_events(sequence)
    stamps, k, start = sequence.depth_timestamps, 0, 0
    while start < len(columns[2]):
        end = start + int(random.integers(1, largest + 1))
        chunk = [column[start:end] for column in columns]
        while k < len(stamps) and stamps[k] < chunk[2][0]:
            yield stamps[k], sequence.depth(k)
            k += 1
        yield chunk[2][-1], *chunk
        start = end
    for j in range(k, len(stamps)):
        yield stamps[j], sequence.depth(j)


def feed(session: Session, data: Any) -> Session:
    for item in data:
        if len(item) == 2:
            session.add_depth(*item)
        else:
            session.add_events(*item[1:])
    return session


# --- to the bit ---


def test_sample_by_sample_is_the_run_to_the_bit(
    slow_depth: EventReplicaSequence, expected: Trajectory
) -> None:
    session = session_for(slow_depth)
    samples = SampledSequence(slow_depth, 0.0, None, 0.05)
    session.add_events(*(a[:10] for a in all_events(slow_depth)))  # those before the first sample's history
    for k, sample in enumerate(samples):
        events = sample.events[10:] if k == 0 and sample.timestamp <= 0.1 else sample.events
        session.add_events(events.x, events.y, events.t, events.polarity)
        if sample.depth is not None:
            session.add_depth(sample.timestamp, sample.depth)
    results = session.finish()
    assert_same(results.trajectory, expected)
    assert results.notes == ()
    assert len(expected) > len(slow_depth.depth_timestamps)  # there are frames without depth


@pytest.mark.parametrize("largest", [40, 3000, 10**6])
def test_random_chunks_are_the_run_to_the_bit(
    largest: int, slow_depth: EventReplicaSequence, expected: Trajectory
) -> None:
    assert_same(feed(session_for(slow_depth), in_chunks(slow_depth, largest)).finish().trajectory, expected)
