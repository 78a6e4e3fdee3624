"""ROS bags of both versions: events in all their encodings, images, IMU."""

import struct
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from event_files.reading import everything
from event_files.written_bags import BagWriter
from event_files.written_prophesee import Event, evt3_words, some_events

from edslam_ti.errors import DataError, MissingExtraError
from edslam_ti.event_files import EventStream, open_events
from edslam_ti.event_files.bags import bag_images, bag_imu, bag_topics, sensor_clock_zero

SIZE = (1280, 720)
START = 1_700_000_000_123_456_789  # ns
KINDS = ("bag", "db3", "mcap")


def assert_holds(stream: EventStream, events: list[Event], start: int = 0) -> None:
    """`start` is added to the stamps, all in microseconds."""
    zero = float(start // 1_000_000)
    found = everything(stream.shifted(zero))
    expected = np.array(events)
    assert len(stream) == len(found) == len(events)
    assert (found.x == expected[:, 0]).all()
    assert (found.y == expected[:, 1]).all()
    assert np.abs(found.t - ((expected[:, 2] + start) / 1e6 - zero)).max() < 1e-9 + 3e-7 * (start > 10**12)
    assert (found.polarity == np.where(expected[:, 3] > 0, 1, -1)).all()


@pytest.mark.parametrize(
    ("kind", "package"),
    [("bag", "prophesee_event_msgs"), ("bag", "dvs_msgs"), ("db3", "dvs_msgs"), ("mcap", "dvs_msgs")],
)
def test_arrays_of_events(tmp_path: Path, kind: str, package: str) -> None:
    events = np.array(some_events(200))
    rows = events.copy()
    rows[:, 2] = START + 1000 * rows[:, 2]
    with BagWriter(tmp_path / "a", kind) as bag:
        for start, end in ((0, 100), (100, 101), (101, 101), (101, 103), (103, 200)):
            bag.events("/cam/left/events", package, rows[start:end], SIZE)
        bag.events("/cam/right/events", package, rows[:5], SIZE)
    assert bag_topics(bag.path) == {"/cam/left/events": "events", "/cam/right/events": "events"}
    stream = open_events(bag.path, group="/cam/left/events")
    assert stream.size == SIZE
    found = everything(stream.shifted(START // 10**9))
    assert (found.x == events[:, 0]).all()
    assert (found.y == events[:, 1]).all()
    assert np.abs(found.t - (rows[:, 2] - START // 10**9 * 10**9) / 1e9).max() < 1e-9
    assert (found.polarity == np.where(events[:, 3] > 0, 1, -1)).all()
    assert stream.time_range == pytest.approx((rows[0, 2] / 1e9, rows[-1, 2] / 1e9), abs=3e-7)
    assert len(open_events(bag.path, group="right")) == 5
    assert len(open_events(bag.path)) == 200  # the left one, and says so
    assert any("/cam/left/events is read" in note for note in open_events(bag.path).notes)


@pytest.mark.parametrize("kind", KINDS)
def test_evt3_packets_go_on(tmp_path: Path, kind: str) -> None:
    events = some_events(2000)
    words = list(evt3_words(events))
    with BagWriter(tmp_path / "a", kind) as bag:
        for k in range(0, len(words), 333):
            part = words[k : k + 333]
            # Messages arrive some 20 ms late, the first one after 1 ms.
            stamp = START + 60_000_000 * k // len(words) + (20_000_000 if k else 1_000_000)
            bag.packet("/e", "evt3", struct.pack(f"<{len(part)}H", *part), SIZE, stamp=stamp)
    stream = open_events(bag.path)
    assert_holds(stream, events)
    assert "the sensor's own; its zero is about 1700000000.1" in stream.notes[0]
    zero = sensor_clock_zero(bag.path)
    assert zero == pytest.approx((START + 1_000_000 - 1000 * events[0].t) / 1e9, abs=1e-6)


def test_libcaer_packets(tmp_path: Path) -> None:
    events = some_events(500, start=(1 << 31) - 30_000)  # the 31 bits of a stamp begin again within a packet
    data = [struct.pack("<II", x << 17 | y << 2 | p << 1 | 1, t & 0x7FFF_FFFF) for x, y, t, p in events]
    with BagWriter(tmp_path / "a", "db3") as bag:
        bag.packet("/e", "libcaer", b"".join(data[:400]), SIZE, time_base=START // 1000 * 1000)
        turns = events[400].t >> 31
        base = START // 1000 * 1000 + (turns << 31) * 1000
        bag.packet("/e", "libcaer", b"".join(data[400:]), SIZE, time_base=base)
    assert_holds(open_events(bag.path), events, START // 1000)


def test_libcaer_cmp_packets(tmp_path: Path) -> None:
    """Columns are shared by the events of a packet, rows come with each event or in vectors of 8."""
    events, words = [], []
    for k, (x, y, p) in enumerate([(10, 20, 1), (1200, 700, 0), (3, 5, 1)]):
        t = 5000 * k + 17
        words += [0x0000 | t >> 12, 0x1000 | t & 0xFFF, 0x2000 | x, 0x3000 | p << 11 | y]
        words += [0x4000 | p << 11 | (y + 1), 0x5000 | 0b10000011, 0x5000 | 0b00000100]
        events += [Event(x, y + step, t, p) for step in (0, 1, 2, 8, 11)]
    with BagWriter(tmp_path / "a", "mcap") as bag:
        for base in (10**18, 10**18 + 20_000_000):  # each packet begins anew
            bag.packet("/e", "libcaer_cmp", struct.pack(f"<{len(words)}H", *words), SIZE, time_base=base)
    expected = events + [event._replace(t=event.t + 20_000) for event in events]
    found = everything(open_events(bag.path).shifted(1e9))
    assert sorted(zip(found.x, found.y, np.rint(1e6 * found.t))) == sorted((e.x, e.y, e.t) for e in expected)


def test_mono_packets(tmp_path: Path) -> None:
    events = some_events(500)
    data = [struct.pack("<Q", p << 63 | y << 48 | x << 32 | 1000 * t) for x, y, t, p in events]
    with BagWriter(tmp_path / "a", "db3") as bag:
        bag.packet("/e", "mono", b"".join(data), SIZE, time_base=5000)
    assert_holds(open_events(bag.path), events, 5)


@pytest.mark.parametrize("kind", KINDS)
def test_images_and_imu(tmp_path: Path, kind: str) -> None:
    random = np.random.default_rng(0)
    grey = random.integers(0, 256, (3, 6, 7), np.uint8)
    depth = random.integers(0, 65536, (3, 6, 7), np.uint16)
    colour = random.integers(0, 256, (6, 7, 3), np.uint8)
    gyro, push = random.normal(size=(2, 4, 3))
    with BagWriter(tmp_path / "a", kind) as bag:
        for k in range(3):
            bag.image("/grey", START + k, grey[k], "mono8")
            bag.image("/depth", START + k, depth[k], "16UC1")
        bag.image("/colour", START, colour, "rgb8")
        bag.image("/metres", START, depth[0].astype(np.float32), "32FC1")
        for k in range(4):
            bag.imu("/imu", START + 1000 * k, gyro[k], push[k])
    assert bag_topics(bag.path) == {
        **dict.fromkeys(("/grey", "/depth", "/colour", "/metres"), "image"),
        "/imu": "imu",
    }
    stamps, images = zip(*bag_images(bag.path, "/grey"))
    assert stamps == tuple((START + k) / 1e9 for k in range(3))
    assert (np.stack(images) == grey).all()
    assert (np.stack([image for _, image in bag_images(bag.path, "/depth")]) == depth).all()
    [(_, found)] = bag_images(bag.path, "/colour")
    assert (found == cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)).all()
    [(_, found)] = bag_images(bag.path, "/metres")
    assert found.dtype == np.float32
    assert (found == depth[0]).all()
    _, rows = zip(*bag_imu(bag.path))
    assert (np.stack(rows) == np.concatenate([gyro, push], 1)).all()
    with pytest.raises(DataError, match="choose one of them as the group"):
        list(bag_images(bag.path))
    with pytest.raises(DataError, match="expected a topic with events, got /grey"):
        open_events(bag.path)


def test_metadata_that_does_not_fit_and_a_single_file(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a", "db3") as bag:
        bag.packet("/e", "mono", struct.pack("<Q", 1), SIZE)
    [storage] = bag.path.glob("*.db3")
    assert len(open_events(storage)) == 1
    (bag.path / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 99}")
    assert len(open_events(bag.path)) == 1
    (bag.path / "metadata.yaml").unlink()
    assert len(open_events(bag.path)) == 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("damage", ["cut", "garbage", "unknown encoding", "no messages"])
def test_a_bad_bag_gets_one_line(tmp_path: Path, kind: str, damage: str) -> None:
    with BagWriter(tmp_path / "a", kind) as bag:
        encoding = "evt9" if damage == "unknown encoding" else "mono"
        for k in range(0 if damage == "no messages" else 300):
            bag.packet("/e", encoding, struct.pack("<Q", k), SIZE, stamp=START + k)
        bag.image("/i", START, np.zeros((4, 4), np.uint8), "mono8")
    path = bag.path if kind == "bag" else next(p for p in bag.path.iterdir() if p.suffix == f".{kind}")
    if damage == "cut":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif damage == "garbage":
        path.write_bytes(b"\x07" * 10_000)
    with pytest.raises(DataError) as caught:
        open_events(path)
    assert "\n" not in str(caught.value)
    words = {
        "unknown encoding": "evt3, libcaer, libcaer_cmp, mono, got 'evt9'",
        "no messages": "expected a topic with events, got /i",
    }
    assert words.get(damage, "copy") in str(caught.value)


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(MissingExtraError) as caught:
        open_events(tmp_path / "a.bag")
    assert "pip install 'edslam-ti[formats]'" in str(caught.value)


# --- real recordings; numbers are those that the tests of event_camera_py and event_camera_codecs state ---


@pytest.mark.parametrize("name", ["test_events_1.bag", "test_events_1", "test_events_1/test_events_1.db3"])
def test_real_evt3(shared_data: Path, name: str) -> None:
    stream = open_events(shared_data / "formats" / "ros_event_bags" / name)
    polarity = everything(stream).polarity
    assert ((polarity < 0).sum(), (polarity > 0).sum()) == (218_291, 125_183)
    assert stream.time_range[0] == 7.139845
    assert (stream.size, stream.num_dropped) == ((640, 480), 0)


def test_real_libcaer_cmp(shared_data: Path) -> None:
    stream = open_events(shared_data / "formats" / "ros_event_bags" / "test_events_2")
    polarity = everything(stream).polarity
    assert ((polarity < 0).sum(), (polarity > 0).sum()) == (360_223, 211_043)
    assert stream.time_range[0] == 1_744_227_144.732712
    assert (stream.size, stream.num_dropped) == ((346, 260), 0)


@pytest.mark.parametrize(
    ("name", "sums"),
    [
        ("test_data_mono_cd", (4_950_000, 34_450, 26_450, 50)),
        ("test_data_evt3_trigger", (1_222_326_831_810_000, 42_078_718, 31_656_267, 41_439)),
    ],
)
def test_real_sums(shared_data: Path, name: str, sums: tuple[int, int, int, int]) -> None:
    events = everything(open_events(shared_data / "formats" / "ros_event_codecs" / name))
    nanoseconds = 1000 * np.rint(1e6 * events.t).astype(np.int64)
    found = (nanoseconds, events.x.astype(int), events.y.astype(int), events.polarity > 0)
    assert tuple(int(values.sum()) for values in found) == sums


def test_real_libcaer_over_a_turn_of_its_counter(shared_data: Path) -> None:
    folder = shared_data / "formats" / "ros_event_codecs" / "test_data_libcaer_rollover"
    stream = open_events(folder)
    assert (len(stream), stream.num_dropped) == (334_331, 0)
    assert np.diff(everything(stream).t).max() < 0.02  # the turn leaves no gap
