"""Real node of ROS 2 (rclpy): plays frames and samples, listens to the poses, prints what it saw.

Runs in an environment of ROS 2, not in that of the tests.
"""

from __future__ import annotations

import argparse
import array
import json
import threading
import time
from pathlib import Path

import events
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image, Imu


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--best_effort", action="store_true")
    parser.add_argument("--no_wait", action="store_true")
    parser.add_argument("--cameras", type=int, default=2)
    parser.add_argument("--limit", type=int, default=0, help="events to send; 0 = all")
    options = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node("player")
    reliability = (
        ReliabilityPolicy.BEST_EFFORT if options.best_effort else ReliabilityPolicy.RELIABLE
    )

    def quality(depth: int) -> QoSProfile:
        return QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=reliability)

    publishers = {-1: node.create_publisher(Imu, "/imu0", quality(200))}
    for camera in range(options.cameras):
        topic = f"/cam{camera}/image_raw"
        publishers[camera] = node.create_publisher(Image, topic, quality(10))
    sent_s: dict[int, float] = {}
    latencies_ms: list[float] = []
    odometry: list[Odometry] = []
    poses: list[PoseStamped] = []

    def take(message: Odometry) -> None:
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        if stamp_ns in sent_s:
            latencies_ms.append(1e3 * (time.monotonic() - sent_s[stamp_ns]))
        odometry.append(message)

    node.create_subscription(Odometry, "/maplab/odometry", take, 50)
    node.create_subscription(PoseStamped, "/maplab/pose_in_map", poses.append, 50)
    spinning = threading.Thread(target=rclpy.spin, args=(node,), daemon=True)
    spinning.start()
    recorded = [e for e in events.load(options.recording) if e[1] < options.cameras]
    recorded = recorded[: options.limit or None]
    deadline_s = time.monotonic() + (0.0 if options.no_wait else 60.0)
    while time.monotonic() < deadline_s:
        if all(p.get_subscription_count() for p in publishers.values()):
            break
        time.sleep(0.05)
    time.sleep(1.0)  # both sides know of each other
    sent = dict.fromkeys(publishers, 0)
    for stamp_ns, sensor, content in events.paced(recorded, options.rate):
        message = Imu() if sensor < 0 else Image()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        if sensor < 0:
            fill_imu(message, content)
        else:
            message.height, message.width = content.shape
            message.step, message.encoding = content.shape[1], "mono8"
            message.data = array.array("B", content.tobytes())
        sent_s[stamp_ns] = time.monotonic()
        publishers[sensor].publish(message)
        sent[sensor] += 1
    events.wait_while_growing(odometry)
    report = {
        "sent": {str(sensor): count for sensor, count in sent.items()},
        "odometry": len(odometry),
        "poses_in_map": len(poses),
        "latency_ms": sorted(latencies_ms),
    }
    if odometry:
        last = odometry[-1]
        report["frames"] = [last.header.frame_id, last.child_frame_id]
        report["sigma_x"] = last.pose.covariance[0] ** 0.5
    print(json.dumps(report), flush=True)
    rclpy.shutdown()
    spinning.join(5.0)


def fill_imu(message: Imu, sample) -> None:
    accel, gyro = message.linear_acceleration, message.angular_velocity
    accel.x, accel.y, accel.z, gyro.x, gyro.y, gyro.z = map(float, sample)


if __name__ == "__main__":
    main()
