"""A session that is fed gives what `edslam slam` gives, to the bit, however the data come in."""

import io
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from sequences import record_tiny_room, settings

from edslam_ti import pipeline
from edslam_ti.config import Config
from edslam_ti.datasets import SampledSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import ConfigError, DataError
from edslam_ti.lenses import Lens
from edslam_ti.session import Session
from edslam_ti.trajectory import Trajectory, read_tum

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


@pytest.mark.parametrize("largest", [40, 3000])
def test_random_chunks_are_the_run_to_the_bit(
    largest: int, slow_depth: EventReplicaSequence, expected: Trajectory
) -> None:
    assert_same(feed(session_for(slow_depth), in_chunks(slow_depth, largest)).finish().trajectory, expected)


def test_all_of_one_stream_before_the_other_is_the_run_to_the_bit(
    slow_depth: EventReplicaSequence, expected: Trajectory
) -> None:
    depth = [(t, slow_depth.depth(k)) for k, t in enumerate(slow_depth.depth_timestamps)]
    session = feed(session_for(slow_depth), [(0, *all_events(slow_depth)), *depth])
    assert_same(session.finish().trajectory, expected)


def test_stamps_of_another_unit_and_numbers_of_other_types(slow_depth: EventReplicaSequence) -> None:
    tracked = config_with(mapping={"enabled": False})
    expected = feed(session_for(slow_depth, tracked), in_chunks(slow_depth, 5000)).finish().trajectory
    session = session_for(slow_depth, tracked, time_unit="us", depth_unit="mm")
    x, y, t, p = all_events(slow_depth)
    since_the_epoch = 1_700_000_000_000_000
    ticks = np.rint(t * 1e6).astype(np.int64) + since_the_epoch
    for k in range(0, len(t), 5000):
        part = slice(k, k + 5000)
        session.add_events(x[part].astype(np.float64), y[part].tolist(), ticks[part], p[part] > 0)
        for j, stamp in enumerate(slow_depth.depth_timestamps):
            if ticks[part][0] <= round(stamp * 1e6) + since_the_epoch <= ticks[part][-1]:
                depth = np.rint(1000 * slow_depth.depth(j)).astype(np.uint16)
                session.add_depth(round(stamp * 1e6) + since_the_epoch, depth[..., None])
    assert session.pose(since_the_epoch + 300_000) is not None
    found = session.finish().trajectory
    assert session.time_offset == 1_700_000_000
    n = len(found)  # the last depth image is after the last event
    np.testing.assert_allclose(found.timestamps, expected.timestamps[:n], atol=1e-6)
    distance = np.linalg.norm(found.poses[:, :3, 3] - expected.poses[:n, :3, 3], axis=1)
    assert distance.max() < 0.001  # metres; some events have moved to the frame before or after


# --- out of order, late, missing, wrong ---


def swapped(data: list[Any]) -> list[Any]:
    """Return the data with every two chunks of events in the other order."""
    chunks = [k for k, item in enumerate(data) if len(item) == 5]
    result = list(data)
    for a, b in zip(chunks[::2], chunks[1::2]):
        if b == a + 1:
            result[a], result[b] = data[b], data[a]
    return result


def test_events_out_of_order_within_the_window_change_nothing(
    slow_depth: EventReplicaSequence, expected: Trajectory
) -> None:
    columns = all_events(slow_depth)
    order = np.arange(len(columns[2]))
    random = np.random.default_rng(1)
    for k in range(0, len(order), 50):
        random.shuffle(order[k : k + 50])
    _, first = np.unique(columns[2], return_index=True)
    assert len(first) > 0.5 * len(order)  # stamps are fine enough for the order to matter
    tracked = config_with(mapping={"enabled": False})
    in_order = feed(session_for(slow_depth, tracked), in_chunks(slow_depth, 2000))
    data = swapped(list(in_chunks(slow_depth, 200)))
    sorted_again = feed(session_for(slow_depth, tracked, reorder=0.1), data)
    assert_same(sorted_again.finish().trajectory, in_order.finish().trajectory)
    assert sorted_again.counts.events_late == 0
    assert sorted_again.notes == in_order.notes == []


def test_late_data_are_left_out_counted_and_told(slow_depth: EventReplicaSequence) -> None:
    session = session_for(slow_depth, config_with(mapping={"enabled": False}))
    feed(session, [item for item in in_chunks(slow_depth, 1000) if item[0] < 0.45])
    before, newest = len(session.trajectory), session.trajectory.timestamps[-1]
    assert before > 3
    session.add_events([3, 4], [5, 6], [0.1, newest + 0.01], [1, 0])  # the first is late
    session.add_depth(0.2, slow_depth.depth(2))
    assert (session.counts.events_late, session.counts.depth_late) == (1, 1)
    results = session.finish()
    assert len(results.trajectory) >= before
    assert "1 events came later than the frame they belong to and are left out" in results.notes
    assert any("1 depth images came later" in note for note in results.notes)


def test_frames_go_on_where_depth_stops(slow_depth: EventReplicaSequence) -> None:
    session = session_for(slow_depth, config_with(mapping={"enabled": False}), patience=0.1)
    data = [item for item in in_chunks(slow_depth, 500) if len(item) == 5 or item[0] < 0.35]
    results = feed(session, data).finish()
    assert results.trajectory.timestamps[-1] > 0.5
    assert abs(np.diff(results.trajectory.timestamps) - 0.05).max() < 0.051


def test_damaged_stamps_do_not_move_the_clock(slow_depth: EventReplicaSequence) -> None:
    session = session_for(slow_depth, config_with(mapping={"enabled": False}))
    x, y, t, p = (column[:3000].astype(np.float64) for column in all_events(slow_depth))
    t[[7, 8]] = 1e12, np.nan
    x[9] = 500
    session.add_events(x, y, t, p)
    assert session.newest < 1
    assert (session.counts.events_damaged, session.counts.events_outside) == (2, 1)


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("add_events", ([1, 2], [1], [0.1], [1]), "one length, got x 2, y 1"),
        ("add_events", (["a"], [1], [0.1], [1]), "x: expected a row of numbers"),
        ("add_events", ([[1]], [[1]], [[0.1]], [[1]]), "x: expected a row of numbers"),
        ("add_depth", (0.1, np.ones((3, 4))), "depth: expected numbers of shape"),
        ("add_depth", (np.nan, np.ones((80, 120))), "t: expected one time stamp"),
        ("add_image", (0.1, np.full((80, 120), 255.0)), "image: expected integers"),
        ("render", (np.eye(3),), "pose: expected a 4x4 matrix"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(
    name: str, arguments: Any, message: str, slow_depth: EventReplicaSequence
) -> None:
    session = session_for(slow_depth)
    session.add_events([1], [1], [0.0], [1])
    with pytest.raises(DataError, match=message):
        getattr(session, name)(*arguments)
    assert session.counts.events == 1


@pytest.mark.parametrize(
    ("differences", "message"),
    [
        ({"method": "event_3dgs"}, "maps with true poses"),
        ({"poses": "truth"}, "poses: a session takes no poses"),
        ({"start": 1.0}, "start: a session takes no start"),
        ({"mapping": {"frames": True}}, "mapping.frames"),
    ],
)
def test_settings_that_need_a_recording_are_refused(
    differences: dict[str, Any], message: str, slow_depth: EventReplicaSequence
) -> None:
    with pytest.raises(ConfigError, match=message):
        Session(slow_depth.camera, Config().updated(differences))


def test_a_session_without_data_says_what_it_got(slow_depth: EventReplicaSequence) -> None:
    session = session_for(slow_depth)
    assert session.pose() is None
    with pytest.raises(DataError, match="there is no frame yet"):
        session.map  # noqa: B018
    session.add_events([1], [1], [0.0], [1])
    with pytest.raises(DataError, match="got 1 events and 0 depth images"):
        session.finish()


# --- reading ---


def test_poses_between_and_after_frames(slow_depth: EventReplicaSequence) -> None:
    session = session_for(slow_depth, config_with(mapping={"enabled": False}))
    feed(session, [item for item in in_chunks(slow_depth, 300) if item[0] < 0.45])
    path = session.trajectory
    last = path.timestamp(-1)
    expected = {None: path.at(session.newest), last: path.pose(-1), 0.31: path.at(0.31), -5: path.pose(0)}
    for t, pose in {**expected, last + 50: path.at(last + 0.1)}.items():
        found = session.pose(t)
        assert found is not None
        np.testing.assert_allclose(found, pose, atol=1e-12)


def test_threads_read_while_it_runs(slow_depth: EventReplicaSequence, expected: Trajectory) -> None:
    session, is_done = session_for(slow_depth), threading.Event()
    seen: dict[str, int] = {"pose": 0, "map": 0, "render": 0}
    failures: list[Exception] = []

    def read(name: str, look: Any) -> None:
        while not is_done.is_set():
            try:
                seen[name] += look() is not None
            except DataError:  # no frame yet
                pass
            except Exception as error:
                failures.append(error)
                return

    looks = {
        "pose": lambda: session.pose(0.3),
        "map": lambda: len(session.map) or None,
        "render": lambda: session.render(
            session.trajectory.pose(-1) if len(session.trajectory) else np.eye(4)
        ),
    }
    threads = [threading.Thread(target=read, args=pair) for pair in looks.items()]
    for thread in threads:
        thread.start()
    feed(session, in_chunks(slow_depth, 2000))
    results = session.finish()
    is_done.set()
    for thread in threads:
        thread.join()
    assert failures == []
    assert min(seen.values()) > 0
    assert_same(results.trajectory, expected)


def test_two_threads_feed_at_once(slow_depth: EventReplicaSequence) -> None:
    tracked = config_with(mapping={"enabled": False})
    session = session_for(slow_depth, tracked, patience=60.0)
    data = list(in_chunks(slow_depth, 2000))
    feeders = [
        threading.Thread(target=feed, args=(session, [item for item in data if len(item) == length]))
        for length in (2, 5)
    ]
    for feeder in feeders:
        feeder.start()
    for feeder in feeders:
        feeder.join()
    one_by_one = feed(session_for(slow_depth, tracked), data)
    assert_same(session.finish().trajectory, one_by_one.finish().trajectory)


# --- results ---


def test_results_have_the_layout_of_a_run(slow_depth: EventReplicaSequence, tmp_path: Path) -> None:
    session = session_for(slow_depth, out=tmp_path, name="mine")
    for k, stamp in enumerate(slow_depth.image_timestamps):
        session.add_image(stamp, np.rint(255 * slow_depth.image(k)).astype(np.uint8))
    results = feed(session, in_chunks(slow_depth, 5000)).finish()
    assert results.folder is not None
    assert results.folder.relative_to(tmp_path).parts[:3] == ("session", "mine", "ed_slam")
    names = {path.name for path in results.folder.iterdir()}
    assert {"trajectory_tum.txt", "map.ply", "mesh.ply", "metrics.json", "renders", "journal.csv"} <= names
    written = read_tum(results.folder / "trajectory_tum.txt")
    np.testing.assert_allclose(written.poses, results.trajectory.poses, atol=1e-8)
    metrics = json.loads((results.folder / "metrics.json").read_text())
    assert metrics["psnr_corrected_db"] > 15
    assert (metrics["num_late_events"], metrics["num_frames_merged"]) == (0, 0)
    assert json.loads((results.folder / "run.json").read_text())["state"] == "finished"
    assert "scene: mine\n" in (results.folder / "config.yaml").read_text()
    with pytest.raises(DataError, match="finished"):
        session.flush()


def test_a_session_that_was_cut_off_cannot_be_resumed(
    slow_depth: EventReplicaSequence, tmp_path: Path
) -> None:
    tracked = config_with(mapping={"enabled": False})
    data = [item for item in in_chunks(slow_depth, 2000) if item[0] < 0.35]
    feed(session_for(slow_depth, tracked, out=tmp_path), data)
    [folder] = (tmp_path / "session/session/ed_slam").iterdir()
    assert len((folder / "journal.csv").read_text().splitlines()) > 2
    (folder / ".lock").unlink()  # as if the process had ended
    with pytest.raises(DataError, match="data of a session cannot be read again"):
        pipeline.resume(folder, tracked)


def test_threshold_is_estimated_from_the_first_images(slow_depth: EventReplicaSequence) -> None:
    config = settings(mapping={"enabled": False})
    session = session_for(slow_depth, config)
    images = [(t, slow_depth.image(k)) for k, t in enumerate(slow_depth.image_timestamps)]
    for item in in_chunks(slow_depth, 2000):
        while images and images[0][0] <= item[0]:
            session.add_image(*images.pop(0))
        feed(session, [item])
    assert len(session.trajectory) == 0  # a second of data is gathered first
    notes = session.finish().notes
    [note] = [line for line in notes if line.startswith("contrast threshold")]
    assert abs(float(note.split()[2]) - 0.1) < 0.02
    assert "from the first images" in note


def test_depth_alone_for_methods_that_need_no_events(slow_depth: EventReplicaSequence) -> None:
    session = session_for(slow_depth, config_with(method="open3d_icp"), has_events=False)
    for k, stamp in enumerate(slow_depth.depth_timestamps):
        session.add_depth(stamp, slow_depth.depth(k))
    assert len(session.trajectory) == len(slow_depth.depth_timestamps)
    with pytest.raises(DataError, match="has no Gaussians"):
        session.map  # noqa: B018
    assert session.points()[0].shape[1] == 3


def test_images_are_waited_for_by_methods_that_track_by_them(slow_depth: EventReplicaSequence) -> None:
    session = session_for(slow_depth, config_with(method="open3d_rgbd"), has_events=False)
    for k, stamp in enumerate(slow_depth.depth_timestamps):
        session.add_depth(stamp, slow_depth.depth(k))
        done = len(session.trajectory)
        session.add_image(stamp, slow_depth.image_at(stamp))
        assert len(session.trajectory) == (0 if k == 0 else k + 1)
        assert done == (0 if k < 2 else k)  # the image was waited for
    results = session.finish()
    assert len(results.trajectory) == len(slow_depth.depth_timestamps)


def test_a_lens_is_undistorted(slow_depth: EventReplicaSequence) -> None:
    lens = Lens(slow_depth.camera, "plumb_bob", (-0.1, 0.02, 0.0, 0.0))
    session = Session(lens, config_with(mapping={"enabled": False}))
    session.add_events([0, 60], [0, 40], [0.0, 0.001], [1, 0])
    events = session._inlet._cutter.queue.between(-1, 1)
    assert 60 in events.x
    assert (0, 0) not in zip(events.x, events.y)
