"""The tables of a VI-map, one row an entity.

Frames: G global, M mission (gravity-aligned, gravity along -z), I = B IMU/body, C camera, S sensor.
Poses are rows [qx qy qz qw px py pz] of T_A_B, which takes coordinates in B to A.
Covariances (6, 6) are ordered position, then orientation, as every tangent vector is.
References between tables are row numbers (int32), `NO_ROW` where there is none. Columns called
`unknown` keep, per row, the serialised fields of newer or foreign writers.
"""

from enum import IntEnum
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I32, I64, U64, NDArray
from maplab_py.vimap.table import Table, column

NO_ROW = -1
IDENTITY_POSE = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


class Backbone(IntEnum):
    """Kind of edges between consecutive vertices of a mission (proto values)."""

    VIWLS = 0
    ODOMETRY = 1


class MissionSensor(IntEnum):
    """Columns of `Missions.sensor_id`."""

    NCAMERA = 0
    IMU = 1
    LIDAR = 2
    ODOMETRY_6DOF = 3
    LOOP_CLOSURE = 4
    ABSOLUTE_6DOF = 5
    DETECTION = 6
    WHEEL_ODOMETRY = 7


class LandmarkQuality(IntEnum):
    """Quality of a landmark (proto values)."""

    UNKNOWN = 0
    BAD = 1
    GOOD = 2


class TransformationKind(IntEnum):
    """Kind of a row among the format's three relative-pose edges (proto field numbers)."""

    ODOMETRY = 2
    TRANSFORMATION = 4
    WHEEL_ODOMETRY = 7


class DescriptorLayout(IntEnum):
    """Layout of the descriptors of a frame in a map file."""

    LEGACY = 0  # bare bytes: one size, binary
    BLOCKS = 1  # maplab 2.2: blocks with headers, each of one type


class ResourceOwner(IntEnum):
    """Owner of a resource."""

    NONE = 0
    FRAME = 1
    MISSION = 2
    SENSOR = 3


class BaseFrames(Table):
    """T_G_M of missions."""

    id: U64 = column(np.uint64, 2)
    T_G_M: F64 = column(np.float64, 7, fill=IDENTITY_POSE)
    T_G_M_covariance: F64 = column(np.float64, 6, 6, fill=np.nan)  # NaN = not in the file
    is_known: NDArray[np.bool_] = column(np.bool_)
    unknown: NDArray[Any] = column(object, fill=b"")


class Missions(Table):
    """Missions: one recording session each."""

    id: U64 = column(np.uint64, 2)
    baseframe: I32 = column(np.int32, fill=NO_ROW)  # row of BaseFrames
    root_vertex: I32 = column(np.int32, fill=NO_ROW)  # row of Vertices
    backbone: NDArray[np.int8] = column(np.int8)
    sensor_id: U64 = column(np.uint64, len(MissionSensor), 2)  # by MissionSensor; zero = none
    unknown: NDArray[Any] = column(object, fill=b"")
    name: NDArray[Any] = column(object, fill="")  # for people; empty = none


class Vertices(Table):
    """States along a mission. Invariant: rows sorted by mission row, then along the graph (time)."""

    id: U64 = column(np.uint64, 2)
    mission: I32 = column(np.int32, fill=NO_ROW)
    T_M_I: F64 = column(np.float64, 7, fill=IDENTITY_POSE)
    v_M: F64 = column(np.float64, 3)  # velocity of I in M, expressed in M [m/s]
    accel_bias: F64 = column(np.float64, 3)  # [m/s^2]
    gyro_bias: F64 = column(np.float64, 3)  # [rad/s]
    timestamp_ns: I64 = column(np.int64)  # of the first frame; from IMU edges where there is none
    nframe_id: U64 = column(np.uint64, 2)  # id of the VisualNFrame; zero = the vertex has none
    unknown: NDArray[Any] = column(object, fill=b"")


class Frames(Table):
    """Images of vertices. Invariant: sorted by vertex row, then camera index.

    `keypoint_count` makes frames the owners of consecutive rows of `Keypoints`
    (`VIMap.keypoint_start` has the offsets).
    """

    id: U64 = column(np.uint64, 2)  # zero = un-set slot of a rig
    vertex: I32 = column(np.int32, fill=NO_ROW)
    camera_index: NDArray[np.int16] = column(np.int16)
    timestamp_ns: I64 = column(np.int64)
    is_valid: NDArray[np.bool_] = column(np.bool_, fill=True)
    keypoint_count: I32 = column(np.int32)
    present: NDArray[np.uint16] = column(np.uint16)  # which optional columns the file had
    # tuple of DescriptorBlock in keypoint order, () or None without descriptors; None also means
    # that the file has no descriptors field
    descriptor_blocks: NDArray[Any] = column(object, fill=None)
    descriptor_layout: NDArray[np.int8] = column(np.int8, fill=DescriptorLayout.BLOCKS)
    unknown: NDArray[Any] = column(object, fill=b"")


class FrameField(IntEnum):
    """Bits of `Frames.present`: optional per-keypoint fields that the frame carries."""

    SIGMA = 1
    SCALE = 2
    TRACK_ID = 4
    POSITION_3D = 8
    TIME_OFFSET = 16
    LANDMARK_ID = 32


class Keypoints(Table):
    """Image measurements, grouped by frame. `landmark` IS the observation; there is no other copy."""

    uv_px: F64 = column(np.float64, 2)  # distorted image
    sigma_px: F64 = column(np.float64, fill=0.8)
    scale: F64 = column(np.float64)
    track_id: I32 = column(np.int32, fill=-1)
    landmark: I32 = column(np.int32, fill=NO_ROW)
    descriptor: NDArray[np.uint8] = column(np.uint8, -1)  # as wide as the widest; floats as bytes
    position_3d: F64 = column(np.float64, -1)  # (K, 3) lidar features, (K, 0) when no frame has any
    time_offset_ns: NDArray[np.int32] = column(np.int32, -1)  # (K, 1) or (K, 0), likewise


class Landmarks(Table):
    """Landmarks. `p_I` is in the body frame of the vertex that stores the landmark."""

    id: U64 = column(np.uint64, 2)
    vertex: I32 = column(np.int32, fill=NO_ROW)
    p_I: F64 = column(np.float64, 3)
    covariance: F64 = column(np.float64, 3, 3, fill=np.nan)  # NaN = none
    quality: NDArray[np.int8] = column(np.int8)
    feature_type: I32 = column(np.int32)
    unknown: NDArray[Any] = column(object, fill=b"")


class ImuEdges(Table):
    """Inertial edges between consecutive vertices, owners of consecutive rows of `ImuSamples`."""

    id: U64 = column(np.uint64, 2)
    from_vertex: I32 = column(np.int32, fill=NO_ROW)
    to_vertex: I32 = column(np.int32, fill=NO_ROW)
    sample_count: I32 = column(np.int32)
    unknown: NDArray[Any] = column(object, fill=b"")


class ImuSamples(Table):
    """IMU measurements; the first and last sample of an edge are at the times of its vertices."""

    timestamp_ns: I64 = column(np.int64)
    accel_gyro: F64 = column(np.float64, 6)  # [ax ay az gx gy gz], m/s^2 and rad/s


class TransformationEdges(Table):
    """Relative poses of a sensor S between two vertices: odometry, wheels, anything else."""

    id: U64 = column(np.uint64, 2)
    kind: NDArray[np.int8] = column(np.int8, fill=TransformationKind.ODOMETRY)
    from_vertex: I32 = column(np.int32, fill=NO_ROW)
    to_vertex: I32 = column(np.int32, fill=NO_ROW)
    T_A_B: F64 = column(np.float64, 7, fill=IDENTITY_POSE)
    covariance: F64 = column(np.float64, 6, 6, fill=np.nan)
    sensor_id: U64 = column(np.uint64, 2)
    unknown: NDArray[Any] = column(object, fill=b"")


class LoopClosureEdges(Table):
    """T_A_B takes the to-vertex' IMU frame (B) to the from-vertex' IMU frame (A)."""

    id: U64 = column(np.uint64, 2)
    from_vertex: I32 = column(np.int32, fill=NO_ROW)
    to_vertex: I32 = column(np.int32, fill=NO_ROW)
    T_A_B: F64 = column(np.float64, 7, fill=IDENTITY_POSE)
    covariance: F64 = column(np.float64, 6, 6, fill=np.nan)
    switch_variable: F64 = column(np.float64, fill=1.0)  # in [0, 1], 1 = trusted
    switch_variable_variance: F64 = column(np.float64)
    unknown: NDArray[Any] = column(object, fill=b"")


class AbsolutePoses(Table):
    """Absolute 6-DoF measurements T_G_S of a sensor, attached to the nearest vertex."""

    vertex: I32 = column(np.int32, fill=NO_ROW)
    timestamp_ns: I64 = column(np.int64)
    sensor_id: U64 = column(np.uint64, 2)
    T_G_S: F64 = column(np.float64, 7, fill=IDENTITY_POSE)
    covariance: F64 = column(np.float64, 6, 6, fill=np.nan)
    unknown: NDArray[Any] = column(object, fill=b"")


class Resources(Table):
    """References to files in the map's resource folders."""

    id: U64 = column(np.uint64, 2)
    type: I32 = column(np.int32)
    owner_kind: NDArray[np.int8] = column(np.int8)  # ResourceOwner
    owner: I32 = column(np.int32, fill=NO_ROW)  # row of Frames or Missions
    sensor_id: U64 = column(np.uint64, 2)  # for ResourceOwner.SENSOR
    timestamp_ns: I64 = column(np.int64)  # for ResourceOwner.SENSOR
    folder: I32 = column(np.int32, fill=-1)  # -1 = the map's own, else index of external folder
