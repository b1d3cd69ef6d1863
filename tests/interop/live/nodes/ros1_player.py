"""Real node of ROS 1 (rospy): plays frames and samples, listens to the poses, prints what it saw.

Runs with Debian's Python, not in the environment of the tests.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import events
import rospy
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image, Imu


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rate", type=float, default=1.0)
    options = parser.parse_args()
    rospy.init_node("player", disable_signals=True)
    publishers = {-1: rospy.Publisher("/imu0", Imu, queue_size=500, tcp_nodelay=True)}
    for camera in (0, 1):
        topic = f"/cam{camera}/image_raw"
        publishers[camera] = rospy.Publisher(topic, Image, queue_size=50, tcp_nodelay=True)
    sent_s: dict[int, float] = {}
    latencies_ms: list[float] = []
    odometry: list[Odometry] = []

    def take(message: Odometry) -> None:
        stamp_ns = message.header.stamp.to_nsec()
        if stamp_ns in sent_s:
            latencies_ms.append(1e3 * (time.monotonic() - sent_s[stamp_ns]))
        odometry.append(message)

    rospy.Subscriber("/maplab/odometry", Odometry, take, queue_size=50)
    recorded = events.load(options.recording)
    deadline_s = time.monotonic() + 60.0
    while time.monotonic() < deadline_s:
        if all(publisher.get_num_connections() for publisher in publishers.values()):
            break
        time.sleep(0.05)
    time.sleep(1.0)  # both sides know of each other
    sent = dict.fromkeys(publishers, 0)
    for stamp_ns, sensor, content in events.paced(recorded, options.rate):
        if sensor < 0:
            message = Imu()
            accel, gyro = message.linear_acceleration, message.angular_velocity
            accel.x, accel.y, accel.z, gyro.x, gyro.y, gyro.z = map(float, content)
        else:
            height, width = content.shape
            message = Image(height=height, width=width, step=width, encoding="mono8")
            message.data = content.tobytes()
        message.header.stamp = rospy.Time(*divmod(stamp_ns, 10**9))
        sent_s[stamp_ns] = time.monotonic()
        publishers[sensor].publish(message)
        sent[sensor] += 1
    events.wait_while_growing(odometry)
    report = {
        "sent": {str(sensor): count for sensor, count in sent.items()},
        "odometry": len(odometry),
        "latency_ms": sorted(latencies_ms),
    }
    if odometry:
        report["frames"] = [odometry[-1].header.frame_id, odometry[-1].child_frame_id]
    print(json.dumps(report), flush=True)
    rospy.signal_shutdown("end")


if __name__ == "__main__":
    main()
