"""Real node of ROS 1 (rospy): plays frames and samples, listens to the poses, prints what it saw.

Runs with Debian's Python, not in the environment of the tests.
"""

from typing import Any

import events
import rospy
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image, Imu


def main() -> None:
    player = events.Player(events.options())
    rospy.init_node("player", disable_signals=True)
    publishers = {-1: rospy.Publisher("/imu0", Imu, queue_size=500, tcp_nodelay=True)}
    for camera in player.cameras:
        topic = f"/cam{camera}/image_raw"
        publishers[camera] = rospy.Publisher(topic, Image, queue_size=50, tcp_nodelay=True)
    last: list[Odometry] = []

    def take(message: Odometry) -> None:
        player.take(message.header.stamp.to_nsec())
        last[:] = [message]

    rospy.Subscriber("/maplab/odometry", Odometry, take, queue_size=50)

    def send(stamp_ns: int, sensor: int, content: Any) -> None:
        message = _imu(content) if sensor < 0 else _image(content)
        message.header.stamp = rospy.Time(*divmod(stamp_ns, 10**9))
        publishers[sensor].publish(message)

    player.play(lambda: all(p.get_num_connections() for p in publishers.values()), send)
    frames = [last[0].header.frame_id, last[0].child_frame_id] if last else []
    player.report(frames=frames)
    rospy.signal_shutdown("end")


def _imu(sample: Any) -> Imu:
    message = Imu()
    accel, gyro = message.linear_acceleration, message.angular_velocity
    accel.x, accel.y, accel.z, gyro.x, gyro.y, gyro.z = map(float, sample)
    return message


def _image(pixels: Any) -> Image:
    height, width = pixels.shape
    message = Image(height=height, width=width, step=width, encoding="mono8")
    message.data = pixels.tobytes()
    return message


if __name__ == "__main__":
    main()
