"""Poses, transforms and landmarks of a running odometry as topics."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.geometry import se3, so3
from maplab_py.interop.bags import sensor_messages
from maplab_py.interop.bags.poses import TF_TOPIC
from maplab_py.interop.live.options import LiveOptions
from maplab_py.interop.live.transport import Transport
from maplab_py.interop.ply import PlyCloud

ODOMETRY_TOPIC, POSE_TOPIC = "/maplab/odometry", "/maplab/pose_in_map"
LANDMARKS_TOPIC = "/maplab/landmarks"


@dataclasses.dataclass(frozen=True, eq=False)
class Estimate:
    """State of the body at one time."""

    time_ns: int
    T_M_I: F64  # (7,)
    v_M_I: F64  # (3,)
    w_I: F64  # (3,) angular velocity [rad/s]
    covariance: F64 | None = None  # (15, 15), order [p, theta, v, b_g, b_a]; None = unknown
    T_G_M: F64 | None = None  # (7,) where M is in a map; None = unknown


class PosePublisher:
    """Publishes estimates as odometry, pose in the map and transforms."""

    def __init__(self, transport: Transport, options: LiveOptions) -> None:
        self._options = options
        self._maker = sensor_messages.MessageMaker(is_ros_2=transport.is_ros_2)
        self._odometry = transport.advertise(ODOMETRY_TOPIC, sensor_messages.ODOMETRY)
        self._pose = transport.advertise(POSE_TOPIC, sensor_messages.POSE)
        self._transforms = transport.advertise(TF_TOPIC, sensor_messages.TREE)
        if options.publish_landmarks:
            self._landmarks = transport.advertise(LANDMARKS_TOPIC, sensor_messages.CLOUD)

    def publish(self, estimate: Estimate) -> None:
        """Publish a state."""
        options, maker = self._options, self._maker
        times_ns = np.array([estimate.time_ns])
        T_M_I = estimate.T_M_I[None]
        pose_covariance, twist_covariance = ros_covariances(estimate)
        odometry = maker.odometry(
            times_ns,
            T_M_I,
            estimate.v_M_I[None],
            (options.odom_frame, options.base_frame),
            w_B=estimate.w_I,
            pose_covariance=pose_covariance.reshape(36),
            twist_covariance=twist_covariance.reshape(36),
        )
        self._odometry(odometry[0])
        transforms = [(T_M_I, (options.odom_frame, options.base_frame))]
        if estimate.T_G_M is not None:
            T_G_M = estimate.T_G_M[None]
            transforms.insert(0, (T_G_M, (options.world_frame, options.odom_frame)))
            T_G_I = se3.compose(T_G_M, T_M_I)
            poses = maker.poses(times_ns, T_G_I, options.world_frame)
            self._pose(poses[0])
        self._transforms(maker.trees(times_ns, transforms)[0])

    def publish_landmarks(self, time_ns: int, p_M: F64) -> None:
        """Publish landmarks (L, 3), if the user wants them."""
        if self._options.publish_landmarks and len(p_M):
            cloud = PlyCloud(p_M)
            self._landmarks(self._maker.cloud(time_ns, self._options.odom_frame, cloud))


def ros_covariances(estimate: Estimate) -> tuple[F64, F64]:
    """Return the covariances (6, 6) of pose and twist as ROS defines them; zeros where unknown.

    ROS's pose covariance is that of the position and of a turn about the axes of the parent frame,
    R = exp(d) R_M_I, so d_M = R_M_I d_I; its twist is in the child frame. Sources:
    geometry_msgs/PoseWithCovariance, nav_msgs/Odometry.
    """
    pose, twist = np.zeros((6, 6)), np.zeros((6, 6))
    if estimate.covariance is None:
        return pose, twist
    R_M_I = so3.to_matrix(estimate.T_M_I[:4])
    J = np.eye(6)
    J[3:, 3:] = R_M_I
    pose = J @ estimate.covariance[:6, :6] @ J.T
    # v_I = R_M_I^T v_M: d v_I = R_M_I^T d v_M + [v_I]x d_I; w_I = gyro - b_g
    J = np.zeros((6, 15))
    J[:3, 3:6] = so3.skew(R_M_I.T @ estimate.v_M_I)
    J[:3, 6:9] = R_M_I.T
    J[3:, 9:12] = -np.eye(3)
    twist = J @ estimate.covariance @ J.T
    return pose, twist
