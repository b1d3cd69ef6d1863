"""A small map of two missions with every kind of row that the exporters read."""

import numpy as np

from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, CameraRig, Distortion, Extrinsics, Imu, Projection, SensorSet
from maplab_py.vimap import (
    BaseFrames,
    Frames,
    ImuEdges,
    ImuSamples,
    Keypoints,
    Landmarks,
    Missions,
    Vertices,
    VIMap,
    ids,
)
from maplab_py.vimap.descriptors import binary_blocks
from maplab_py.vimap.tables import LandmarkQuality, MissionSensor

IMU_ID, RIG_ID, CAMERA_ID = "a" * 32, "b" * 32, "c" * 32
START_NS = 1403715273262142976
VERTICES, MISSIONS, PERIOD_NS, RATE = 6, 2, 500_000_000, 100


def make_sensors() -> SensorSet:
    camera = Camera(
        id=CAMERA_ID,
        projection=Projection.PINHOLE,
        distortion=Distortion.FOV,
        intrinsics=np.array([250.0, 251.0, 320.0, 240.0]),
        distortion_parameters=np.array([0.9]),
        width_px=640,
        height_px=480,
    )
    T_B_C = se3.make(so3.exp([[0.1, 0.2, 0.3]]), [[0.1, 0.0, -0.1]])
    T_I_B = se3.make(so3.exp([0.0, 0.0, 1.0]), [0.5, 0.0, 0.0])
    return SensorSet(
        {IMU_ID: Imu(IMU_ID), RIG_ID: CameraRig(RIG_ID, (camera,), T_B_C)},
        {IMU_ID: Extrinsics(IMU_ID, se3.identity()), RIG_ID: Extrinsics(IMU_ID, T_I_B)},
    )


def position(t: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(t), np.cos(t), 0.1 * t**2], axis=-1)


def velocity(t: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(t), -np.sin(t), 0.2 * t], axis=-1)


def make_map() -> VIMap:
    rng = np.random.default_rng(8)
    count = VERTICES * MISSIONS
    mission = np.repeat(np.arange(MISSIONS), VERTICES)
    step = np.tile(np.arange(VERTICES), MISSIONS)
    times = START_NS + mission * 10**11 + step * PERIOD_NS
    t = step * PERIOD_NS * 1e-9
    q = so3.exp(np.stack([0 * t, 0.3 * t, 0 * t], axis=1))
    sensor_id = np.zeros((MISSIONS, len(MissionSensor), 2), dtype=np.uint64)
    sensor_id[:, MissionSensor.IMU] = ids.from_hex(IMU_ID)
    sensor_id[:, MissionSensor.NCAMERA] = ids.from_hex(RIG_ID)
    per_frame, landmarks = 4, 5
    keypoints = count * per_frame
    edge_from = np.flatnonzero(step < VERTICES - 1)
    per_edge = PERIOD_NS * RATE // 10**9 + 1
    sample_times = times[edge_from][:, None] + np.arange(per_edge) * (10**9 // RATE)
    landmark = np.tile([0, 1, 2, -1], count)
    landmark[keypoints // 2 :] = np.tile([2, 3, 4, -1], count // 2)
    return VIMap(
        sensors=make_sensors(),
        missions=Missions.filled(
            MISSIONS,
            id=ids.random_ids(MISSIONS, rng),
            baseframe=np.arange(MISSIONS),
            sensor_id=sensor_id,
        ),
        baseframes=BaseFrames.filled(
            MISSIONS,
            id=ids.random_ids(MISSIONS, rng),
            T_G_M=se3.make(so3.exp(rng.normal(size=(MISSIONS, 3))), rng.normal(size=(MISSIONS, 3))),
        ),
        vertices=Vertices.filled(
            count,
            id=ids.random_ids(count, rng),
            mission=mission,
            timestamp_ns=times,
            T_M_I=se3.make(q, position(t)),
            v_M=velocity(t),
            accel_bias=rng.normal(size=(count, 3)),
            gyro_bias=rng.normal(size=(count, 3)),
        ),
        frames=Frames.filled(
            count,
            id=ids.random_ids(count, rng),
            vertex=np.arange(count),
            timestamp_ns=times,
            keypoint_count=np.full(count, per_frame),
            descriptor_blocks=binary_blocks(
                np.full(count, per_frame), np.where(mission == 0, 48, 3)
            ),
        ),
        keypoints=Keypoints.filled(
            keypoints,
            uv_px=rng.uniform(0, 480, (keypoints, 2)),
            landmark=landmark,
            track_id=np.arange(keypoints),
            descriptor=rng.integers(0, 256, (keypoints, 48)),
        ),
        landmarks=Landmarks.filled(
            landmarks,
            id=ids.random_ids(landmarks, rng),
            vertex=[0, 1, 2, 6, 7],
            p_I=rng.normal(size=(landmarks, 3)),
            quality=[LandmarkQuality.GOOD] * 3 + [LandmarkQuality.BAD] * 2,
        ),
        imu_edges=ImuEdges.filled(
            len(edge_from),
            id=ids.random_ids(len(edge_from), rng),
            from_vertex=edge_from,
            to_vertex=edge_from + 1,
            sample_count=np.full(len(edge_from), per_edge),
        ),
        imu_samples=ImuSamples.filled(
            sample_times.size,
            timestamp_ns=sample_times.reshape(-1),
            accel_gyro=rng.normal(size=(sample_times.size, 6)),
        ),
    )
