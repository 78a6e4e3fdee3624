"""Stamps of a recording: one clock, told from indices and from other units, exact since the epoch, too."""

import json
from pathlib import Path

import numpy as np
import pytest
from written_sequences import CAMERA, some_events, write_sequence

from edslam_ti.config import Config
from edslam_ti.datasets import SampledSequence, open_sequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import ConfigError, DataError

EPOCH = 1642650000


def renamed(folder: Path, name: str, number: dict[int, int]) -> None:
    """Rename images of the given milliseconds."""
    moved = [(p, number[int(p.stem[5:])]) for p in sorted((folder / name).glob("*.png"))]
    for path, k in moved:
        path.rename(path.with_name(f"moved{k:06d}.png"))
    for path, k in moved:
        path.with_name(f"moved{k:06d}.png").rename(path.with_name(f"frame{k:06d}.png"))


def by_index(folder: Path, step: int = 1, first: int = 0) -> Path:
    """Number depth and grey images by index; there is one every 50 ms."""
    write_sequence(folder)
    for name in ("depth", "images"):
        renamed(folder, name, {ms: first + step * (ms // 50) for ms in range(0, 301, 50)})
    return folder


@pytest.mark.parametrize(("step", "first"), [(1, 0), (1, 1), (1, 500), (3, 0), (7, 0)])
def test_indices_are_not_taken_for_milliseconds(tmp_path: Path, step: int, first: int) -> None:
    folder = by_index(tmp_path / "s", step, first)
    expected = (
        rf"depth: the numbers in the names look like indices, not milliseconds: 7 files, {first} to "
        rf"{first + 6 * step}, would span 0\.0\d+ s, the events span 0\.3 s; .*--depth-rate.*timestamps\.txt"
    )
    with pytest.raises(DataError, match=expected):
        EventReplicaSequence(folder)


def test_a_rate_gives_indices_their_times(tmp_path: Path) -> None:
    folder = by_index(tmp_path / "a")
    given = EventReplicaSequence(folder, depth_rate=20.0)
    assert given.notes == [f"{folder / 'images'}: numbered like depth: assumed at the same rate, 20 Hz"]
    (folder / "camera.json").write_text(json.dumps(CAMERA | {"depth_rate": 20, "image_rate": 20}))
    stated = EventReplicaSequence(folder)
    assert stated.notes == []
    original = EventReplicaSequence(write_sequence(tmp_path / "b"))
    for sequence in (given, stated):
        assert sequence.depth_timestamps == pytest.approx(original.depth_timestamps, abs=1e-12)
        assert sequence.image_timestamps == pytest.approx(original.image_timestamps, abs=1e-12)
        assert (sequence.depth(3) == original.depth(3)).all()


def test_settings_can_state_the_rate(tmp_path: Path) -> None:
    folder = by_index(tmp_path / "a")
    config = Config(scene="a", data_dir=tmp_path, depth_rate=20.0, image_rate=10.0)
    sequence = open_sequence(config)
    assert sequence.depth_timestamps == pytest.approx(np.arange(7) / 20)
    assert sequence.image_timestamps == pytest.approx(np.arange(7) / 10)
    with pytest.raises(ConfigError, match="image_rate: expected with event_replica alone, got it with rpg"):
        open_sequence(Config(scene=folder.name, data_dir=tmp_path, dataset="rpg", image_rate=10.0))


def test_files_of_times_give_indices_theirs(tmp_path: Path) -> None:
    folder = by_index(tmp_path / "a")
    lines = [f"{name} {0.05 * k + 0.001:.6f}\n" for k, name in enumerate(
        ("0", "frame000001", "frame000002.png", "000003", "4", "5", "6", "99"))]  # fmt: skip
    (folder / "depth/timestamps.txt").write_text("# number, seconds\n" + "".join(lines[::-1]))
    with pytest.raises(DataError, match=r"images: the numbers in the names look like indices.*image_rate"):
        EventReplicaSequence(folder)
    (folder / "images/timestamps.txt").write_text("".join(lines))
    sequence = EventReplicaSequence(folder)
    assert sequence.depth_timestamps == pytest.approx(np.arange(7) * 0.05 + 0.001)
    assert sequence.depth(2)[5, 5] == pytest.approx(1.1)
    for text, message in {
        "0 0.1 0.2\n": r"timestamps\.txt: line 1: expected lines 'number_or_name seconds', got '0 0\.1 0\.2'",
        "0.1\n": r"line 1: expected lines 'number_or_name seconds', got '0\.1'",
        "0 0\n00 1\n": r"line 2: a second time for 00",
        "0 0\n": r"got none for frame000001\.png \(6 such files\)",
        "".join(f"{k} 0.1\n" for k in range(7)): r"expected a time for each image, got 0\.100000 s for both",
        "".join(f"{k} {EPOCH + k}\n" for k in range(7)): r"clocks differ: depth/timestamps\.txt covers 164",
    }.items():
        (folder / "depth/timestamps.txt").write_text(text)
        with pytest.raises(DataError, match=message):
            EventReplicaSequence(folder)


def test_little_depth_is_noted(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "s")
    for ms in (0, 50, 250, 300):
        (folder / f"depth/frame{ms:06d}.png").unlink()
    sequence = EventReplicaSequence(folder)
    assert [n for n in sequence.notes if n.startswith("depth covers 0.1 s of the events' 0.3 s: 3 images")]


def test_depth_outside_the_events_is_left_out_and_noted(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "s", events=some_events(end=0.12))
    sequence = EventReplicaSequence(folder)
    assert len(SampledSequence(sequence, 0.0, None, 0.05)) == 3
    assert sequence.notes == [
        "4 of 7 depth images are not within the events' time, 0.000023 to 0.119947 s, and are left out"
    ]


def epoch_sequence(folder: Path, epoch: float) -> EventReplicaSequence:
    """Stamps since the epoch, to the microsecond, in names, events and poses."""
    events = some_events()
    events[:, 2] += epoch
    write_sequence(folder, events)
    for name in ("depth", "images"):
        renamed(folder, name, {ms: int(1000 * epoch) + ms for ms in range(0, 301, 50)})
    rows = [f"{int(epoch)}.{25000 * k + 660:06d}\n" for k in range(12)]
    (folder / "poses_ts.txt").write_text("".join(rows))
    (folder / "traj.txt").write_text("".join((folder / "traj.txt").read_text().splitlines(True)[:12]))
    return EventReplicaSequence(folder)


@pytest.mark.parametrize("interval", [0.05, 0.025, 0.0125, 0.01, 0.007])
def test_stamps_since_the_epoch_add_no_samples(tmp_path: Path, interval: float) -> None:
    late, zero = epoch_sequence(tmp_path / "a", EPOCH), EventReplicaSequence(write_sequence(tmp_path / "b"))
    assert late.time_offset == EPOCH
    a, b = (SampledSequence(s, 0.0, None, interval) for s in (late, zero))
    assert (a.timestamps == b.timestamps).all()
    assert late.truth is not None
    assert late.truth.timestamps == pytest.approx(np.arange(12) * 0.025 + 0.00066, abs=3e-7)


def test_noisy_epoch_stamps_add_no_samples() -> None:
    """float64 seconds since the epoch are multiples of 0.24 us; milliseconds are rounded by half of one."""
    exact = np.arange(1, 400) * 0.05
    late = exact + np.random.default_rng(0).uniform(-4e-4, 4e-4, 399)
    for stamps in ((EPOCH + 0.37 + exact) - EPOCH, exact.round(3), late.round(3)):
        samples = SampledSequence(Stamped(stamps), 0.0, None, 0.05)
        assert len(samples) == len(stamps)


class Stamped(EventReplicaSequence):
    """Depth of ones at given times, among events of 30 s."""

    time_range = (0.0, 30.0)
    scene = "stamped"

    def __init__(self, stamps: np.ndarray) -> None:
        self.depth_timestamps = stamps

    def depth(self, index: int) -> np.ndarray:
        return np.ones((3, 4), np.float32)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t * 1e9, r"poses_ts\.txt covers 0 to 300000000 s.*looks as if it were in nanoseconds"),
        (lambda t: t * 1e6, r"poses_ts\.txt covers 0 to 300000 s.*looks as if it were in microseconds"),
        (lambda t: t + EPOCH, r"poses_ts\.txt covers 1642650000 to 1642650000\.3 s, events 5\.7.* to 0\.29"),
        (lambda t: t + 100, r"the clocks differ: poses_ts\.txt covers 100 to 100\.3 s"),
        (lambda t: t / 1e3, r"the clocks differ: poses_ts.* events look as if they were in milli"),
        (lambda t: EPOCH * 1e9 + t * 1e9, r"the clocks differ: poses_ts\.txt covers 1\.64265e\+18"),
    ],
)
def test_truth_of_another_clock_is_refused(tmp_path: Path, change: object, message: str) -> None:
    folder = write_sequence(tmp_path / "s")
    assert callable(change)
    np.savetxt(folder / "poses_ts.txt", change(np.arange(13) * 0.025), fmt="%.9f")
    with pytest.raises(DataError, match=message):
        EventReplicaSequence(folder)


def test_truth_that_is_much_longer_than_the_events_is_accepted(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "s")
    times = np.arange(13) * 0.025
    times[12] = 5000.0  # motion capture went on
    np.savetxt(folder / "poses_ts.txt", times)
    assert EventReplicaSequence(folder).truth is not None


def test_truth_out_of_order_is_sorted_and_noted(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "s")
    expected = EventReplicaSequence(folder).truth
    order = np.random.default_rng(0).permutation(13)
    for name in ("poses_ts.txt", "traj.txt"):
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines[k] for k in [*order, 4]).encode())
    sequence = EventReplicaSequence(folder)
    assert sequence.truth is not None
    assert expected is not None
    assert (sequence.truth.timestamps == expected.timestamps).all()
    assert (sequence.truth.poses == expected.poses).all()
    assert ["rows repeat a time" in n or "not in the order" in n for n in sequence.notes] == [True, True]


def test_a_stale_first_event_is_no_other_unit(tmp_path: Path) -> None:
    events = some_events()
    events[1:, 2] += 200.0
    folder = write_sequence(tmp_path / "s", events)
    for name in ("depth", "images"):
        renamed(folder, name, {ms: 200_000 + ms for ms in range(0, 301, 50)})
    expected = r"poses_ts\.txt covers 0 to 0\.3 s, events 200\.0.* to 200\.2"
    with pytest.raises(DataError, match=expected) as caught:
        EventReplicaSequence(folder)
    assert "looks as if" not in str(caught.value)
    assert "look as if" not in str(caught.value)
