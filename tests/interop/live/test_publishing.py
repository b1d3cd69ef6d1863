"""What is published of an estimate, read back with the library's own parser."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.geometry import se3, so3
from maplab_py.interop.live.options import LiveOptions
from maplab_py.interop.live.publishing import Estimate, PosePublisher, ros_covariances
from maplab_py.interop.recordings.bag_files import message_types
from tests.interop.live.support import FakeTransport


def random_estimate(seed: int, *, is_localised: bool = True) -> Estimate:
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(15, 15))
    q = so3.exp(rng.normal(size=(2, 3)))
    poses = np.concatenate([q, rng.normal(size=(2, 3))], axis=1)
    return Estimate(
        5_000_000_001,
        poses[0],
        rng.normal(size=3),
        rng.normal(size=3),
        factor @ factor.T,
        poses[1] if is_localised else None,
    )


@pytest.mark.parametrize("is_ros_2", [True, False])
def test_the_estimate_is_in_the_messages(is_ros_2: bool) -> None:
    transport, estimate = FakeTransport(is_ros_2=is_ros_2), random_estimate(1)
    publisher = PosePublisher(transport, LiveOptions(publish_landmarks=True))
    publisher.publish(estimate)
    publisher.publish_landmarks(5, np.ones((4, 3)))
    store = message_types(is_ros_2=is_ros_2)
    decode = store.deserialize_cdr if is_ros_2 else store.deserialize_ros1
    odometry = decode(transport.published["/maplab/odometry"][0], "nav_msgs/msg/Odometry")
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "imu")
    assert (odometry.header.stamp.sec, odometry.header.stamp.nanosec) == (5, 1)
    pose_covariance, twist_covariance = ros_covariances(estimate)
    assert np.array_equal(odometry.pose.covariance, pose_covariance.reshape(36))
    assert np.array_equal(odometry.twist.covariance, twist_covariance.reshape(36))
    v_I = so3.rotate(so3.inverse(estimate.T_M_I[:4]), estimate.v_M_I)
    linear, angular = odometry.twist.twist.linear, odometry.twist.twist.angular
    assert np.allclose([linear.x, linear.y, linear.z], v_I)
    assert np.array_equal([angular.x, angular.y, angular.z], estimate.w_I)
    pose = decode(transport.published["/maplab/pose_in_map"][0], "geometry_msgs/msg/PoseStamped")
    assert pose.header.frame_id == "map"
    position = pose.pose.position
    T_G_I = se3.compose(estimate.T_G_M, estimate.T_M_I)
    assert np.allclose([position.x, position.y, position.z], T_G_I[4:])
    transforms = decode(transport.published["/tf"][0], "tf2_msgs/msg/TFMessage").transforms
    frames = [(t.header.frame_id, t.child_frame_id) for t in transforms]
    assert frames == [("map", "odom"), ("odom", "imu")]
    cloud = decode(transport.published["/maplab/landmarks"][0], "sensor_msgs/msg/PointCloud2")
    assert cloud.width == 4


def test_without_a_map_there_is_no_pose_in_it() -> None:
    transport = FakeTransport()
    PosePublisher(transport, LiveOptions()).publish(random_estimate(2, is_localised=False))
    assert transport.published["/maplab/pose_in_map"] == []
    message = message_types(is_ros_2=True).deserialize_cdr(
        transport.published["/tf"][0], "tf2_msgs/msg/TFMessage"
    )
    assert [t.child_frame_id for t in message.transforms] == ["imu"]


def numeric_jacobian(estimate: Estimate, tangent_of: object) -> F64:
    step = 1e-6
    columns = []
    for row in range(15):
        d = np.zeros(15)
        d[row] = step
        columns.append((tangent_of(d) - tangent_of(-d)) / (2 * step))  # type: ignore[operator]
    return np.array(columns).T


def test_covariances_are_those_that_ros_defines() -> None:
    estimate = random_estimate(3)
    q, p = estimate.T_M_I[:4], estimate.T_M_I[4:]

    def pose(d: F64) -> F64:
        turned = so3.multiply(q, so3.exp(d[3:6]))
        return np.concatenate([p + d[:3], so3.log(so3.multiply(turned, so3.inverse(q)))])

    def twist(d: F64) -> F64:
        turned = so3.multiply(q, so3.exp(d[3:6]))
        v_I = so3.rotate(so3.inverse(turned), estimate.v_M_I + d[6:9])
        return np.concatenate([v_I, estimate.w_I - d[9:12]])

    for covariance, tangent in zip(ros_covariances(estimate), (pose, twist), strict=True):
        J = numeric_jacobian(estimate, tangent)
        assert np.allclose(covariance, J @ estimate.covariance @ J.T, rtol=1e-5, atol=1e-6)


def test_an_unknown_covariance_is_zero() -> None:
    estimate = Estimate(1, se3.identity(), np.zeros(3), np.zeros(3))
    assert not np.any(ros_covariances(estimate))
