"""Rooms full of points with descriptors, walked through once or more: small maps with known truth."""

import dataclasses
from typing import Any

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
from maplab_py.vimap.descriptors import binary_blocks
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
    recorded = _Recorder(np.random.default_rng([seed, 2]), flips, noise_px)
    for walk in walks:
        recorded.walk(walk)
    return recorded.as_map(), np.array(recorded.truth)


@dataclasses.dataclass
class _Recorder:
    """What the walks so far have seen."""

    rng: np.random.Generator
    flips: float
    noise_px: float
    poses: list[NDArray] = dataclasses.field(default_factory=list)
    truth: list[NDArray] = dataclasses.field(default_factory=list)
    mission: list[int] = dataclasses.field(default_factory=list)
    time_ns: list[int] = dataclasses.field(default_factory=list)
    frames: list[dict[str, NDArray]] = dataclasses.field(default_factory=list)
    landmark_vertex: list[int] = dataclasses.field(default_factory=list)
    landmark_p_I: list[NDArray] = dataclasses.field(default_factory=list)

    def walk(self, walk: Walk) -> None:
        """Add the vertices, frames and landmarks of one walk."""
        p, descriptors = room_points(walk.room)
        p = p + walk.room_at
        side = np.linspace(-1.0, 1.0, walk.vertices)
        side = side + self.rng.normal(scale=0.05, size=walk.vertices)
        position = np.stack([0.4 * side**2, side, 0.2 * np.sin(3 * side)], axis=1) + walk.room_at
        q = so3.exp(self.rng.normal(scale=0.05, size=(walk.vertices, 3)))
        T_G_I = se3.make(q, position)
        landmark_of_point = np.full(POINTS, -1)
        for i in range(walk.vertices):
            self._look(T_G_I[i], p, descriptors, landmark_of_point)
            self.mission.append(walk.mission)
            self.time_ns.append(round((walk.start_s + 0.5 * i) * 1e9))
        self.poses += list(se3.compose(yaw.to_pose(np.array(walk.drift)), T_G_I))
        self.truth += list(T_G_I)

    def _look(
        self, T_G_I: NDArray, p: NDArray, descriptors: NDArray, landmark_of_point: NDArray
    ) -> None:
        """Add a frame of the points p (POINTS, 3) and landmarks of those never seen before."""
        uv, visible = project(CAMERA, se3.transform(se3.inverse(se3.compose(T_G_I, T_I_C)), p))
        uv = uv + self.rng.normal(scale=self.noise_px, size=uv.shape)
        seen = np.flatnonzero(visible & is_inside_image(CAMERA, uv))
        for point in seen[landmark_of_point[seen] < 0]:
            landmark_of_point[point] = len(self.landmark_vertex)
            self.landmark_vertex.append(len(self.frames))
            self.landmark_p_I.append(se3.transform(se3.inverse(T_G_I), p[point]))
        flipped = self.rng.random((len(seen), 384)) < self.flips
        bits = np.unpackbits(descriptors[seen], axis=1) ^ flipped
        self.frames.append(
            {"uv": uv[seen], "d": np.packbits(bits, axis=1), "landmark": landmark_of_point[seen]}
        )

    def as_map(self) -> VIMap:
        """Return the map of all walks."""
        rng = self.rng
        return VIMap(
            sensors=SensorSet(
                {IMU_ID: Imu(IMU_ID), RIG_ID: CameraRig(RIG_ID, (CAMERA,), T_I_C[None])}
            ),
            **self._mission_tables(),
            **self._vertex_tables(),
            landmarks=Landmarks.filled(
                len(self.landmark_vertex),
                id=random_ids(len(self.landmark_vertex), rng),
                vertex=self.landmark_vertex,
                p_I=np.array(self.landmark_p_I),
                quality=np.full(len(self.landmark_vertex), LandmarkQuality.GOOD),
            ),
        )

    def _mission_tables(self) -> dict[str, Any]:
        count = max(self.mission) + 1
        sensor_id = np.zeros((count, len(MissionSensor), 2), dtype=np.uint64)
        sensor_id[:, MissionSensor.IMU] = from_hex(IMU_ID)
        sensor_id[:, MissionSensor.NCAMERA] = from_hex(RIG_ID)
        return {
            "missions": Missions.filled(
                count,
                id=random_ids(count, self.rng),
                baseframe=np.arange(count),
                root_vertex=np.array([self.mission.index(m) for m in range(count)]),
                sensor_id=sensor_id,
            ),
            "baseframes": BaseFrames.filled(
                count, id=random_ids(count, self.rng), is_known=np.ones(count, dtype=bool)
            ),
        }

    def _vertex_tables(self) -> dict[str, Any]:
        count = len(self.frames)
        keypoints = [len(frame["uv"]) for frame in self.frames]
        return {
            "vertices": Vertices.filled(
                count,
                id=random_ids(count, self.rng),
                mission=self.mission,
                T_M_I=np.array(self.poses),
                timestamp_ns=self.time_ns,
                nframe_id=random_ids(count, self.rng),
            ),
            "frames": Frames.filled(
                count,
                id=random_ids(count, self.rng),
                vertex=np.arange(count),
                timestamp_ns=self.time_ns,
                keypoint_count=keypoints,
                descriptor_blocks=binary_blocks(keypoints, 48),
            ),
            "keypoints": Keypoints.filled(
                sum(keypoints),
                uv_px=np.concatenate([frame["uv"] for frame in self.frames]),
                landmark=np.concatenate([frame["landmark"] for frame in self.frames]),
                descriptor=np.concatenate([frame["d"] for frame in self.frames]),
            ),
        }
