"""Small exact maps: a camera on an IMU walks past random points, one map or several pieces."""

import numpy as np

from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, CameraRig, Distortion, Extrinsics, Imu, Projection, SensorSet
from maplab_py.sensors.projection import is_inside_image, project
from maplab_py.vimap import (
    AbsolutePoses,
    BaseFrames,
    Frames,
    ImuEdges,
    ImuSamples,
    Keypoints,
    LandmarkQuality,
    Landmarks,
    LoopClosureEdges,
    Missions,
    MissionSensor,
    TransformationEdges,
    Vertices,
    VIMap,
)
from maplab_py.vimap.descriptors import binary_blocks
from maplab_py.vimap.ids import from_hex, random_ids

IMU_ID, RIG_ID, CAMERA_ID, ODOMETRY_ID = "1" * 32, "2" * 32, "3" * 32, "4" * 32
STEP_NS = 100_000_000
SAMPLES = 5
T_I_C = np.array([0.0, 0.0, 0.0, 1.0, 0.05, 0.0, 0.0])


def sensors(focal_px: float = 300.0) -> SensorSet:
    camera = Camera(
        id=CAMERA_ID,
        projection=Projection.PINHOLE,
        distortion=Distortion.NONE,
        intrinsics=np.array([focal_px, focal_px, 320.0, 240.0]),
        distortion_parameters=np.zeros(0),
        width_px=640,
        height_px=480,
    )
    rig = CameraRig(id=RIG_ID, cameras=(camera,), T_B_C=T_I_C[None])
    mount = {s: Extrinsics(base_sensor_id=IMU_ID, T_B_S=se3.identity()) for s in (IMU_ID, RIG_ID)}
    return SensorSet(sensors={IMU_ID: Imu(id=IMU_ID), RIG_ID: rig}, extrinsics=mount)


def walk_map(
    vertices: int = 12, landmarks: int = 60, seed: int = 0, first_ns: int = 10**9
) -> VIMap:
    """One mission with exact observations, IMU, odometry, two loop closures and absolute poses."""
    rng = np.random.default_rng(seed)
    steps = np.arange(vertices)
    T_M_I = se3.make(
        so3.exp(np.stack([0.01 * steps, -0.02 * steps, 0.0 * steps], axis=1)),
        np.stack([0.3 * steps, 0.05 * np.sin(steps), 0.02 * steps], axis=1),
    )
    p_M = rng.uniform([-2.0, -2.0, 4.0], [0.3 * vertices + 2.0, 2.0, 8.0], (landmarks, 3))
    T_G_M = se3.make(so3.exp([0.0, 0.0, 0.4]), [1.0, 2.0, 3.0])
    time = first_ns + STEP_NS * steps
    store = rng.integers(0, vertices, landmarks)
    keypoints, counts = _keypoints(T_M_I, p_M, rng)
    sensor_id = np.zeros((1, len(MissionSensor), 2), dtype=np.uint64)
    sensor_id[0, MissionSensor.IMU] = from_hex(IMU_ID)
    sensor_id[0, MissionSensor.NCAMERA] = from_hex(RIG_ID)
    edges = vertices - 1
    samples = (time[:-1, None] + np.linspace(0, STEP_NS, SAMPLES).astype(np.int64)).reshape(-1)
    return VIMap(
        sensors=sensors(),
        missions=Missions.filled(
            1, id=random_ids(1, rng), baseframe=[0], root_vertex=[0], sensor_id=sensor_id
        ),
        baseframes=BaseFrames.filled(1, id=random_ids(1, rng), T_G_M=T_G_M[None]),
        vertices=Vertices.filled(
            vertices,
            id=random_ids(vertices, rng),
            mission=np.zeros(vertices),
            T_M_I=T_M_I,
            v_M=rng.normal(size=(vertices, 3)),
            timestamp_ns=time,
            nframe_id=random_ids(vertices, rng),
        ),
        frames=Frames.filled(
            vertices,
            id=random_ids(vertices, rng),
            vertex=steps,
            timestamp_ns=time,
            keypoint_count=counts,
            descriptor_blocks=binary_blocks(counts, 8),
        ),
        keypoints=keypoints,
        landmarks=Landmarks.filled(
            landmarks,
            id=random_ids(landmarks, rng),
            vertex=store,
            p_I=se3.transform(se3.inverse(T_M_I[store]), p_M),
            quality=np.full(landmarks, LandmarkQuality.GOOD),
        ),
        imu_edges=ImuEdges.filled(
            edges,
            id=random_ids(edges, rng),
            from_vertex=steps[:-1],
            to_vertex=steps[1:],
            sample_count=np.full(edges, SAMPLES),
        ),
        imu_samples=ImuSamples.filled(
            len(samples), timestamp_ns=samples, accel_gyro=rng.normal(size=(len(samples), 6))
        ),
        transformation_edges=TransformationEdges.filled(
            edges,
            id=random_ids(edges, rng),
            from_vertex=steps[:-1],
            to_vertex=steps[1:],
            T_A_B=se3.relative(T_M_I[:-1], T_M_I[1:]),
            covariance=np.broadcast_to(np.diag(rng.uniform(1e-4, 1e-3, 6)), (edges, 6, 6)),
        ),
        loop_closure_edges=LoopClosureEdges.filled(
            2, id=random_ids(2, rng), from_vertex=[0, 1], to_vertex=[vertices - 1, vertices - 2]
        ),
        absolute_poses=AbsolutePoses.filled(
            2, vertex=[2, vertices - 3], timestamp_ns=time[[2, -3]]
        ),
    )


def _keypoints(T_M_I: np.ndarray, p_M: np.ndarray, rng: np.random.Generator):
    camera = sensors().camera_rig(RIG_ID).cameras[0]
    T_M_C = se3.compose(T_M_I, T_I_C)
    p_C = se3.transform(se3.inverse(T_M_C)[:, None], p_M[None])
    uv, visible = project(camera, p_C)
    vertex, landmark = np.nonzero(visible & is_inside_image(camera, uv))
    count = len(vertex)
    keypoints = Keypoints.filled(
        count,
        uv_px=uv[vertex, landmark],
        landmark=landmark,
        track_id=landmark,
        descriptor=rng.integers(0, 256, (count, 8)),
    )
    return keypoints, np.bincount(vertex, minlength=len(T_M_I))
