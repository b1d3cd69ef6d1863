"""Real node of ROS 2 (rclpy): plays frames and samples, listens to the poses, prints what it saw.

Runs in an environment of ROS 2, not in that of the tests.
"""

import array
import threading
from typing import Any

import events
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image, Imu


def main() -> None:
    options = events.options()
    player = events.Player(options)
    rclpy.init()
    node = rclpy.create_node("player")
    reliability = (
        ReliabilityPolicy.BEST_EFFORT if options.best_effort else ReliabilityPolicy.RELIABLE
    )

    def quality(depth: int) -> QoSProfile:
        return QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=reliability)

    publishers = {-1: node.create_publisher(Imu, "/imu0", quality(200))}
    for camera in player.cameras:
        topic = f"/cam{camera}/image_raw"
        publishers[camera] = node.create_publisher(Image, topic, quality(10))
    last: list[Odometry] = []
    poses = 0

    def take(message: Odometry) -> None:
        player.take(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
        last[:] = [message]

    def take_pose(_: PoseStamped) -> None:
        nonlocal poses
        poses += 1

    node.create_subscription(Odometry, "/maplab/odometry", take, 50)
    node.create_subscription(PoseStamped, "/maplab/pose_in_map", take_pose, 50)
    spinning = threading.Thread(target=rclpy.spin, args=(node,), daemon=True)
    spinning.start()

    def send(stamp_ns: int, sensor: int, content: Any) -> None:
        message = _imu(content) if sensor < 0 else _image(content)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        publishers[sensor].publish(message)

    player.play(lambda: all(p.get_subscription_count() for p in publishers.values()), send)
    more: dict[str, Any] = {"poses_in_map": poses}
    if last:
        more["frames"] = [last[0].header.frame_id, last[0].child_frame_id]
        more["sigma_x"] = last[0].pose.covariance[0] ** 0.5
    player.report(**more)
    rclpy.shutdown()
    spinning.join(5.0)


def _imu(sample: Any) -> Imu:
    message = Imu()
    accel, gyro = message.linear_acceleration, message.angular_velocity
    accel.x, accel.y, accel.z, gyro.x, gyro.y, gyro.z = map(float, sample)
    return message


def _image(pixels: Any) -> Image:
    message = Image(encoding="mono8")
    message.height, message.width = pixels.shape
    message.step = message.width
    message.data = array.array("B", pixels.tobytes())
    return message


if __name__ == "__main__":
    main()
