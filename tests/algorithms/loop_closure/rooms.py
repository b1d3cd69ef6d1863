"""Rooms full of points with descriptors, walked through once or more: small maps with known truth."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.geometry import se3, so3, yaw
from maplab_py.sensors import Camera, CameraRig, Distortion, Imu, Projection, SensorSet
from maplab_py.sensors.projection import is_inside_image, project
from maplab_py.vimap import (
    BaseFrames,
    Frames,
    Keypoints,
    LandmarkQuality,
    Landmarks,
    Missions,
    MissionSensor,
    Vertices,
    VIMap,
)
from maplab_py.vimap.ids import from_hex, random_ids

IMU_ID, RIG_ID, CAMERA_ID = "1" * 32, "2" * 32, "3" * 32
CAMERA = Camera(
    CAMERA_ID,
    Projection.PINHOLE,
    Distortion.NONE,
    np.array([300.0, 300.0, 320.0, 240.0]),
    np.zeros(0),
    640,
    480,
)
# the camera looks along x of the body, z of the body is up
T_I_C = se3.make(
    so3.from_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])), [0.1, 0, 0]
)
POINTS = 250


@dataclasses.dataclass(frozen=True)
class Walk:
    """One pass through a room; every pass has landmarks of its own."""

    room: int  # seed of the room's points
    mission: int = 0
    start_s: float = 0.0
    vertices: int = 12
    drift: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # x y z [m], yaw [rad]
    room_at: tuple[float, float, float] = (0.0, 0.0, 0.0)


def room_points(room: int) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return points (POINTS, 3) on a wall 5 to 6 m ahead, and their descriptors."""
    rng = np.random.default_rng([room, 1])
    low, high = [5.0, -4.0, -2.0], [6.5, 4.0, 2.0]
    return rng.uniform(low, high, (POINTS, 3)), rng.integers(0, 256, (POINTS, 48), np.uint8)


def make_map(
    walks: list[Walk], *, seed: int = 0, flips: float = 0.05, noise_px: float = 0.3
) -> tuple[VIMap, NDArray[np.float64]]:
    """Return a map of the walks, missions in order, and the true poses (V, 7)."""
    rng = np.random.default_rng([seed, 2])
    missions = max(walk.mission for walk in walks) + 1
    poses, truth, mission, time_ns = [], [], [], []
    frames: list[dict[str, NDArray]] = []
    landmark_vertex, landmark_p_I = [], []
    vertex = landmark = 0
    for walk in walks:
        p, descriptors = room_points(walk.room)
        p = p + walk.room_at
        side = np.linspace(-1.0, 1.0, walk.vertices) + rng.normal(scale=0.05, size=walk.vertices)
        position = np.stack([0.4 * side**2, side, 0.2 * np.sin(3 * side)], axis=1) + walk.room_at
        q = so3.exp(rng.normal(scale=0.05, size=(walk.vertices, 3)))
        T_G_I = se3.make(q, position)
        drifted = se3.compose(yaw.to_pose(np.array(walk.drift)), T_G_I)
        first_seen = np.full(POINTS, -1)
        for i in range(walk.vertices):
            p_C = se3.transform(se3.inverse(se3.compose(T_G_I[i], T_I_C)), p)
            uv, visible = project(CAMERA, p_C)
            uv = uv + rng.normal(scale=noise_px, size=uv.shape)
            seen = np.flatnonzero(visible & is_inside_image(CAMERA, uv))
            for point in seen[first_seen[seen] < 0]:
                first_seen[point] = landmark
                landmark_vertex.append(vertex)
                landmark_p_I.append(se3.transform(se3.inverse(T_G_I[i]), p[point]))
                landmark += 1
            bits = np.unpackbits(descriptors[seen], axis=1) ^ (rng.random((len(seen), 384)) < flips)
            frames.append(
                {"uv": uv[seen], "d": np.packbits(bits, axis=1), "landmark": first_seen[seen]}
            )
            poses.append(drifted[i])
            truth.append(T_G_I[i])
            mission.append(walk.mission)
            time_ns.append(round((walk.start_s + 0.5 * i) * 1e9))
            vertex += 1
    ids = np.zeros((missions, len(MissionSensor), 2), dtype=np.uint64)
    ids[:, MissionSensor.IMU], ids[:, MissionSensor.NCAMERA] = from_hex(IMU_ID), from_hex(RIG_ID)
    root = np.array([mission.index(m) for m in range(missions)])
    vi_map = VIMap(
        sensors=SensorSet({IMU_ID: Imu(IMU_ID), RIG_ID: CameraRig(RIG_ID, (CAMERA,), T_I_C[None])}),
        missions=Missions.filled(
            missions,
            id=random_ids(missions, rng),
            baseframe=np.arange(missions),
            root_vertex=root,
            sensor_id=ids,
        ),
        baseframes=BaseFrames.filled(
            missions, id=random_ids(missions, rng), is_known=np.ones(missions, dtype=bool)
        ),
        vertices=Vertices.filled(
            vertex,
            id=random_ids(vertex, rng),
            mission=mission,
            T_M_I=np.array(poses),
            timestamp_ns=time_ns,
            nframe_id=random_ids(vertex, rng),
        ),
        frames=Frames.filled(
            vertex,
            id=random_ids(vertex, rng),
            vertex=np.arange(vertex),
            timestamp_ns=time_ns,
            keypoint_count=[len(f["uv"]) for f in frames],
            descriptor_size=np.full(vertex, 48),
        ),
        keypoints=Keypoints.filled(
            sum(len(f["uv"]) for f in frames),
            uv_px=np.concatenate([f["uv"] for f in frames]),
            landmark=np.concatenate([f["landmark"] for f in frames]),
            descriptor=np.concatenate([f["d"] for f in frames]),
        ),
        landmarks=Landmarks.filled(
            landmark,
            id=random_ids(landmark, rng),
            vertex=landmark_vertex,
            p_I=np.array(landmark_p_I),
            quality=np.full(landmark, LandmarkQuality.GOOD),
        ),
    )
    return vi_map, np.array(truth)
