"""Writes ROS bags with events, images and IMU through the serialisers of rosbags."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

EVENT = "uint16 x\nuint16 y\n{time} ts\nbool polarity\n"
ARRAY = "std_msgs/Header header\nuint32 height\nuint32 width\n{package}/Event[] events\n"
PACKET = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
    "bool is_bigendian\nuint8[] events\n"
)


@cache
def _types(is_ros1: bool) -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    time = "time" if is_ros1 else "builtin_interfaces/Time"
    for package in ("dvs_msgs", "prophesee_event_msgs"):
        store.register(get_types_from_msg(EVENT.format(time=time), f"{package}/msg/Event"))
        store.register(get_types_from_msg(ARRAY.format(package=package), f"{package}/msg/EventArray"))
    store.register(get_types_from_msg(PACKET, "event_camera_msgs/msg/EventPacket"))
    return store


class BagWriter:
    """Writes one bag: "bag" (ROS 1), "db3" or "mcap" (ROS 2)."""

    def __init__(self, path: Path, kind: str) -> None:
        self.path = path.with_suffix(".bag") if kind == "bag" else path
        self._is_ros1 = kind == "bag"
        self._store = _types(self._is_ros1)
        self._types = self._store.types
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self._writer: Any = (
            Writer1(self.path) if self._is_ros1 else Writer2(path, version=8, storage_plugin=plugin)
        )
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> "BagWriter":
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def write(self, topic: str, type_name: str, stamp: int, **fields: Any) -> None:
        """Write a message with a header of a stamp in nanoseconds."""
        header = self._header(stamp)
        message = self._types[type_name](header=header, **fields)
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, type_name, typestore=self._store)
        serialize = self._store.serialize_ros1 if self._is_ros1 else self._store.serialize_cdr
        self._writer.write(self._connections[topic], stamp, serialize(message, type_name))

    def events(self, topic: str, package: str, rows: np.ndarray, size: tuple[int, int]) -> None:
        """Write rows [N, 4] of x, y, t [ns], p as one array."""
        event = self._types[f"{package}/msg/Event"]
        events = [event(int(x), int(y), self._time(int(t)), bool(p)) for x, y, t, p in rows]
        stamp = int(rows[-1, 2]) if len(rows) else 1
        self.write(topic, f"{package}/msg/EventArray", stamp, height=size[1], width=size[0], events=events)

    def packet(self, topic: str, encoding: str, data: bytes, size: tuple[int, int], **fields: Any) -> None:
        self.write(
            topic,
            "event_camera_msgs/msg/EventPacket",
            fields.pop("stamp", 1),
            height=size[1],
            width=size[0],
            seq=0,
            time_base=fields.pop("time_base", 0),
            encoding=encoding,
            is_bigendian=fields.pop("is_bigendian", False),
            events=np.frombuffer(data, np.uint8),
        )

    def image(self, topic: str, stamp: int, image: np.ndarray, encoding: str) -> None:
        rows = np.ascontiguousarray(image)
        self.write(
            topic,
            "sensor_msgs/msg/Image",
            stamp,
            height=image.shape[0],
            width=image.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.strides[0],
            data=rows.view(np.uint8).ravel(),
        )

    def imu(self, topic: str, stamp: int, gyro: np.ndarray, acceleration: np.ndarray) -> None:
        vector, quaternion = (self._types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Quaternion"))
        covariance = np.zeros(9)
        self.write(
            topic,
            "sensor_msgs/msg/Imu",
            stamp,
            orientation=quaternion(0.0, 0.0, 0.0, 1.0),
            orientation_covariance=covariance,
            angular_velocity=vector(*gyro.tolist()),
            angular_velocity_covariance=covariance,
            linear_acceleration=vector(*acceleration.tolist()),
            linear_acceleration_covariance=covariance,
        )

    def _time(self, stamp: int) -> Any:
        return self._types["builtin_interfaces/msg/Time"](*divmod(stamp, 1_000_000_000))

    def _header(self, stamp: int) -> Any:
        header = self._types["std_msgs/msg/Header"]
        sequence = {"seq": 7} if self._is_ros1 else {}
        return header(**sequence, stamp=self._time(stamp), frame_id="odd")
