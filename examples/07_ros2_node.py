"""python examples/07_ros2_node.py

A ROS 2 node: events and depth come in as messages, poses go out. rclpy comes with ROS 2 and not from PyPI, so
the package does not import it; event_camera_py decodes the packets of ROS' event camera drivers
(apt install ros-$ROS_DISTRO-event-camera-py). Topics: events, depth (16UC1 in mm, drawn into the event
camera), pose. Not tried with hardware. Ctrl-C ends it, refines the map and saves.
"""

from typing import Any

import numpy as np
import rclpy
from event_camera_msgs.msg import EventPacket
from event_camera_py import Decoder
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import Image

import edslam_ti
from edslam_ti.camera import Camera

CAMERA = Camera(width=640, height=480, fx=560.0, fy=560.0, cx=319.5, cy=239.5)  # yours, undistorted


class SlamNode(Node):
    """Feeds a session with what comes, and publishes the newest pose after every packet of events."""

    def __init__(self, session: edslam_ti.Session) -> None:
        super().__init__("edslam")
        self.session, self.decoder = session, Decoder()
        self.create_subscription(EventPacket, "events", self.on_events, 100)
        self.create_subscription(Image, "depth", self.on_depth, 10)
        self.poses = self.create_publisher(PoseStamped, "pose", 10)

    def on_events(self, message: Any) -> None:
        self.decoder.decode(message)
        events = self.decoder.get_cd_events()  # structured: x, y, p, t in the sensor's microseconds, 32 bits
        if len(events):
            since_first = (events["t"] - events["t"][0]).astype(np.int64)
            self.session.add_events(
                events["x"], events["y"], microseconds(message) + since_first, events["p"]
            )
        pose = self.session.pose()
        if pose is not None:
            out = PoseStamped()
            out.header.stamp, out.header.frame_id = message.header.stamp, "map"
            out.pose.position.x, out.pose.position.y, out.pose.position.z = map(float, pose[:3, 3])
            self.poses.publish(out)

    def on_depth(self, message: Any) -> None:
        depth = np.frombuffer(message.data, np.uint16).reshape(message.height, message.width)
        self.session.add_depth(microseconds(message), depth)


def microseconds(message: Any) -> int:
    """Return a message's stamp."""
    return int(message.header.stamp.sec) * 1_000_000 + message.header.stamp.nanosec // 1000


def main(camera: Camera = CAMERA, **settings: Any) -> edslam_ti.Session:
    """Spin until Ctrl-C; `settings` are those of `edslam slam --help`."""
    rclpy.init()
    config = edslam_ti.Config(**settings)
    session = edslam_ti.Session(camera, config, time_unit="us", depth_unit="mm", out=config.out, name="ros2")
    try:
        rclpy.spin(SlamNode(session))
    except KeyboardInterrupt:
        print(session.finish().folder)
    return session


if __name__ == "__main__":
    main()
