"""ROS bags: ROS 1 `.bag`, ROS 2 `.db3` and `.mcap`, alone or in a folder with metadata.yaml.

Events are dvs_msgs/EventArray, prophesee_event_msgs/EventArray (the same layout), event_camera_msgs/
EventPacket or its predecessor event_array_msgs/EventArray, encoded as evt3, libcaer, libcaer_cmp or mono.
Bags may also hold images (grey or depth) and IMU: `bag_images`, `bag_imu`.

Stamps of events are those of the messages. In evt3 and mono packets they are of the sensor's own clock, which
starts with the sensor; a note then says how it relates to the clock of the messages' headers.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.errors import DataError, MissingExtraError, plain
from edslam_ti.event_files.bag_messages import EventReader, image_of, imu_of, is_packet
from edslam_ti.event_files.choice import chosen
from edslam_ti.event_files.decoded import DecodedRows, Parts
from edslam_ti.event_files.hdf5 import INSTALL
from edslam_ti.event_files.stream import Clock

SUFFIXES = (".bag", ".db3", ".mcap")
STORAGES = (".db3", ".mcap")  # of ROS 2
BYTES_PER_EVENT = 3  # least that events take in a bag, encoded as evt3
# Encodings with stamps of the sensor's own clock
OWN_CLOCK = ("evt3", "mono")


class Bag:
    """A recording that is open for reading; a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_ros1 = path.suffix.lower() == ".bag"
        self._readers: list[Any] = []

    def __enter__(self) -> "Bag":
        with _one_line(self.path):
            for reader in self._all_readers():
                reader.open()
                self._readers.append(reader)
        return self

    def __exit__(self, *_: object) -> None:
        for reader in self._readers:
            reader.close()

    def topics(self) -> dict[str, str]:
        """Return the types of messages by topic, such as "sensor_msgs/msg/Imu"."""
        return {c.topic: c.msgtype for reader in self._readers for c in reader.connections}

    def messages(self, topic: str) -> Iterator[tuple[bytes, float]]:
        """Yield a topic's messages in the order of their times, and the share that has been read."""
        connections = [[c for c in reader.connections if c.topic == topic] for reader in self._readers]
        total = sum(c.msgcount for row in connections for c in row)
        number = 0
        with _one_line(self.path):
            for reader, wanted in zip(self._readers, connections):
                for _, _, data in reader.messages(wanted) if wanted else ():
                    number += 1
                    yield data, number / max(total, number)

    def _all_readers(self) -> list[Any]:
        try:
            from rosbags import rosbag1, rosbag2
        except ModuleNotFoundError as error:
            raise MissingExtraError(f"{self.path}: ROS bags need {INSTALL}") from error
        if self.is_ros1:
            return [rosbag1.Reader(self.path)]
        if not self.path.is_dir():
            return [rosbag2.Reader(self.path)]
        try:
            with rosbag2.Reader(self.path):
                return [rosbag2.Reader(self.path)]
        except (rosbag2.ReaderError, FileNotFoundError):  # metadata.yaml is missing or does not fit
            return [rosbag2.Reader(file) for file in _storages(self.path)]


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Turn what the reader of bags raises into one line."""
    try:
        yield
    except (MissingExtraError, DataError, GeneratorExit):
        raise
    except MemoryError:
        raise
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path}: not a ROS bag ({plain(error)})") from error
    except sqlite3.Error as error:
        raise DataError(
            f"{path}: not readable as a ROS bag ({plain(error)}); copy or download it again"
        ) from error
    except Exception as error:  # the reader lets errors of its parsers through: struct, lz4, KeyError, ...
        raise DataError(
            f"{path}: not readable as a ROS bag ({plain(error) or type(error).__name__}); copy it again, or "
            "repair it with 'rosbag reindex' or 'ros2 bag reindex'"
        ) from error


def is_bag(path: Path) -> bool:
    """Return whether a file or a folder is a ROS bag."""
    return bool(_storages(path)) if path.is_dir() else path.suffix.lower() in SUFFIXES


def _storages(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in STORAGES)


def bag_topics(path: Path) -> dict[str, str]:
    """Return what a bag holds, by topic: "events", "image", "imu", or the type of other messages."""
    with Bag(path) as bag:
        return {topic: _kind(type_name) for topic, type_name in bag.topics().items()}


def _kind(type_name: str) -> str:
    name = type_name.rsplit("/", 1)[-1]
    if name == "EventArray" or is_packet(type_name):
        return "events"
    if type_name.startswith("sensor_msgs/"):
        return {"Image": "image", "CompressedImage": "image", "Imu": "imu"}.get(name, type_name)
    return type_name


def _chosen_topic(path: Path, kind: str, wanted: str | None) -> tuple[str, str, list[str]]:
    """Return topic, type of messages, and notes."""
    with Bag(path) as bag:
        topics = bag.topics()
    there = [topic for topic, type_name in topics.items() if _kind(type_name) == kind]
    if not there:
        found = ", ".join(f"{topic} ({type_name})" for topic, type_name in topics.items())
        raise DataError(f"{path}: expected a topic with {kind}, got {plain(found) or 'none'}")
    topic, notes = chosen(str(path), f"topics with {kind}", there, wanted)
    return topic, topics[topic], notes


def bag_rows(path: Path, group: str | None) -> tuple[DecodedRows, tuple[int, int]]:
    """Return the events of a topic, and the size of the image that its messages state."""
    topic, type_name, notes = _chosen_topic(path, "events", group)
    read = EventReader(type_name, path.suffix.lower() == ".bag")
    with Bag(path) as bag:
        first = next((read(data) for data, _ in bag.messages(topic)), None)
    if first is None:
        raise DataError(f"{path} ({topic}): expected messages with events, got none")
    if read.encoding in OWN_CLOCK and len(first.events):
        offset = (first.stamp - int(first.events.t[0])) / 1e9
        notes.append(
            f"stamps are the sensor's own; its zero is about {offset:.3f} s of the clock of the messages"
        )
    size = sum(file.stat().st_size for file in (_storages(path) if path.is_dir() else [path]))
    rows = DecodedRows(
        path,
        lambda rows: _parts(rows, type_name),
        clock=Clock(1e9),
        most_events=size // BYTES_PER_EVENT,
        part=topic,
    )
    rows.opening_notes = notes
    return rows, first.size


def _parts(rows: DecodedRows, type_name: str) -> Parts:
    with Bag(rows.path) as bag:
        read = EventReader(type_name, bag.is_ros1)
        for data, share in bag.messages(rows.part):
            yield _in_topic(rows.name, read, data).events, share


def _in_topic(name: str, read: Any, *arguments: Any) -> Any:
    try:
        return read(*arguments)
    except DataError as error:
        raise DataError(f"{name}: a message {error}") from error


def bag_images(path: Path, topic: str | None = None) -> Iterator[tuple[float, np.ndarray]]:
    """Yield the images of a topic with their times, s of the messages' headers.

    They are grey [H, W] uint8, or depth as it is stored: [H, W] uint16 or float32. Raises `DataError`.
    """
    name, type_name, _ = _chosen_topic(path, "image", topic)
    is_compressed = type_name.endswith("CompressedImage")
    with Bag(path) as bag:
        for data, _ in bag.messages(name):
            stamp, image = _in_topic(f"{path} ({name})", image_of, data, bag.is_ros1, is_compressed)
            yield stamp / 1e9, image


def bag_imu(path: Path, topic: str | None = None) -> Iterator[tuple[float, np.ndarray]]:
    """Yield times (s) and measurements [6]: angular velocity (rad/s), acceleration (m/s^2)."""
    name, _, _ = _chosen_topic(path, "imu", topic)
    with Bag(path) as bag:
        for data, _ in bag.messages(name):
            stamp, values = _in_topic(f"{path} ({name})", imu_of, data, bag.is_ros1)
            yield stamp / 1e9, values
