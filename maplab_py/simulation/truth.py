"""Ground truth of a simulated data set, stored separately from the maps."""

import dataclasses
from pathlib import Path
from typing import Self

import numpy as np

from maplab_py.algorithms.localization.database import LocalizationMap
from maplab_py.algorithms.localization.localization import Localizations, Reference
from maplab_py.array_types import F64, I64, U64, NDArray
from maplab_py.atomic import replaced_file
from maplab_py.errors import UserError
from maplab_py.geometry import alignment, se3, so3
from maplab_py.input_files import read_npz
from maplab_py.interop.trajectories import Trajectory
from maplab_py.sensors import CameraRig, Imu, ImuIntrinsics, SensorSet
from maplab_py.sensors.camera import CAMERA_MODELS, DISTORTION_SIZE, INTRINSICS_SIZE
from maplab_py.simulation.recording import Recording
from maplab_py.simulation.sensors import Device, mission_frame
from maplab_py.simulation.world import World
from maplab_py.vimap import IdIndex, VIMap, from_hex

STATIONARY_MPS, STATIONARY_RADPS = 1e-3, 1e-3
"""Speed limits below which the body is at rest."""
_MOST_PARAMETERS = max(INTRINSICS_SIZE[p] + DISTORTION_SIZE[d] for p, d in CAMERA_MODELS)


@dataclasses.dataclass(frozen=True, eq=False)
class Truth:
    """True values by id. G is the frame of the simulated world."""

    mission_id: U64  # (M, 2)
    T_G_M: F64  # (M, 7)
    vertex_id: U64  # (V, 2)
    vertex_mission: I64  # (V,) row of mission_id
    vertex_time_ns: I64  # (V,)
    T_G_I: F64  # (V, 7)
    v_G: F64  # (V, 3)
    accel_bias: F64  # (V, 3)
    gyro_bias: F64  # (V, 3)
    is_stationary: NDArray[np.bool_]  # (V,)
    landmark_id: U64  # (L, 2) of the maps' landmarks
    landmark_point: I64  # (L,) the world point that most of its observations show
    frame_id: U64  # (F, 2) of the maps' frames
    frame_keypoints: I64  # (F,) number of keypoints
    keypoint_point: I64  # (K,) world point that a keypoint shows, -1 = none; frame after frame
    keypoint_landmark: I64  # (K,) row of landmark_id that it observed at first, -1 = none
    keypoint_uv_px: F64  # (K, 2) without noise
    sample_mission: I64  # (S,) row of mission_id; S IMU samples
    sample_time_ns: I64  # (S,)
    sample_T_G_I: F64  # (S, 7)
    sample_v_G: F64  # (S, 3)
    sample_accel_bias: F64  # (S, 3)
    sample_gyro_bias: F64  # (S, 3)
    loop_edge_id: U64  # (E, 2)
    loop_edge_is_true: NDArray[np.bool_]  # (E,)
    imu_id: U64  # (M, 2)
    imu_T_g: F64  # (M, 3, 3)
    imu_T_a: F64  # (M, 3, 3)
    imu_R_A_I: F64  # (M, 3, 3)
    camera_id: U64  # (M, C, 2)
    camera_parameters: F64  # (M, C, 13) intrinsics, then distortion, then NaN
    T_I_C: F64  # (M, C, 7)
    point_G: F64  # (P, 3) world points
    point_look: I64  # (P,) points of equal number have the same appearance
    point_moving: I64  # (P,) number of the object that carries the point about, -1 = none

    def save(self, path: Path) -> None:
        """Write the truth to an .npz file."""
        with replaced_file(path) as file:
            np.savez_compressed(file, **dataclasses.asdict(self))

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a truth file written by `save`.

        Raises:
            UserError: The file is missing or is not such a file.
        """
        names = [field.name for field in dataclasses.fields(cls)]
        try:
            content = read_npz(path)
            return cls(**{name: content[name] for name in names})
        except FileNotFoundError:
            raise UserError(f"{path}: there is no such truth file") from None
        except (OSError, ValueError, KeyError) as error:
            raise UserError(f"{path} is not a truth file: {error}") from None

    @classmethod
    def concatenate(cls, parts: list[Self]) -> Self:
        """Join the truths of sessions in one world."""
        sizes = np.cumsum([0, *(len(part.mission_id) for part in parts)])
        values = {
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in dataclasses.fields(cls)
        }
        for name in ("vertex_mission", "sample_mission"):
            values[name] = np.concatenate(
                [getattr(part, name) + size for part, size in zip(parts, sizes, strict=False)]
            )
        landmarks = np.cumsum([0, *(len(part.landmark_id) for part in parts)])
        values["keypoint_landmark"] = np.concatenate(
            [
                np.where(part.keypoint_landmark >= 0, part.keypoint_landmark + before, -1)
                for part, before in zip(parts, landmarks, strict=False)
            ]
        )
        first = parts[0]
        for name in ("point_G", "point_look", "point_moving"):
            values[name] = getattr(first, name)
        return cls(**values)

    def trajectory(self, source: str) -> Trajectory:
        """Return the true poses at IMU rate of all sessions, in the order of time."""
        order = np.argsort(self.sample_time_ns, kind="stable")
        return Trajectory(
            self.sample_time_ns[order],
            self.sample_T_G_I[order],
            v_R=self.sample_v_G[order],
            gyro_bias=self.sample_gyro_bias[order],
            accel_bias=self.sample_accel_bias[order],
            source=source,
        )


def session_truth(
    vi_map: VIMap,
    recording: Recording,
    device: Device,
    world: World,
    point_of: I64,
    loop_edge_is_true: NDArray[np.bool_],
) -> Truth:
    """Return the truth of a session.

    Args:
        vi_map: Its map, for the ids.
        device: With the true calibration.
        point_of: World point (L,) of every landmark of the map.
        loop_edge_is_true: Which loop closure edges (E,) of the map join what they claim to.
    """
    row, motion, detections = recording.imu_row, recording.motion, recording.keypoints
    cameras = device.true_rig.cameras
    parameters = np.full((1, len(cameras), _MOST_PARAMETERS), np.nan)
    for number, camera in enumerate(cameras):
        values = np.concatenate([camera.intrinsics, camera.distortion_parameters])
        parameters[0, number, : len(values)] = values
    speed, rate = np.linalg.norm(motion.v_G, axis=1), np.linalg.norm(motion.w_I, axis=1)
    return Truth(
        mission_id=vi_map.missions.id,
        T_G_M=mission_frame(motion.T_G_I[0])[None],
        vertex_id=vi_map.vertices.id,
        vertex_mission=np.zeros(len(row), dtype=np.int64),
        vertex_time_ns=recording.time_ns,
        T_G_I=motion.T_G_I,
        v_G=motion.v_G,
        accel_bias=recording.imu.accel_bias[row],
        gyro_bias=recording.imu.gyro_bias[row],
        is_stationary=(speed < STATIONARY_MPS) & (rate < STATIONARY_RADPS),
        landmark_id=vi_map.landmarks.id,
        landmark_point=point_of,
        frame_id=vi_map.frames.id,
        frame_keypoints=vi_map.frames.keypoint_count.astype(np.int64),
        keypoint_point=detections.point,
        keypoint_landmark=vi_map.keypoints.landmark.astype(np.int64),
        keypoint_uv_px=detections.uv_true_px,
        sample_mission=np.zeros(len(recording.imu_time_ns), dtype=np.int64),
        sample_time_ns=recording.imu_time_ns,
        sample_T_G_I=recording.imu_motion.T_G_I,
        sample_v_G=recording.imu_motion.v_G,
        sample_accel_bias=recording.imu.accel_bias,
        sample_gyro_bias=recording.imu.gyro_bias,
        loop_edge_id=vi_map.loop_closure_edges.id,
        loop_edge_is_true=loop_edge_is_true,
        imu_id=from_hex(device.imu_id)[None],
        imu_T_g=device.true_imu.T_g[None],
        imu_T_a=device.true_imu.T_a[None],
        imu_R_A_I=device.true_imu.R_A_I[None],
        camera_id=np.stack([from_hex(camera.id) for camera in cameras])[None],
        camera_parameters=parameters,
        T_I_C=device.true_rig.T_B_C[None],
        point_G=world.p_G,
        point_look=world.look,
        point_moving=world.moving,
    )


def true_map(vi_map: VIMap, truth: Truth) -> VIMap:
    """Return the map with true poses, velocities, biases, landmarks, base frames and calibrations.

    Measurements do not change. Each landmark gets the position of the world point that most of its
    observations show. Sensors get their calibration in the first session that uses them.

    Raises:
        UserError: The truth is of another data set.
    """
    vertex = IdIndex(truth.vertex_id).rows(vi_map.vertices.id)
    mission = IdIndex(truth.mission_id).rows(vi_map.missions.id)
    landmark = IdIndex(truth.landmark_id).rows(vi_map.landmarks.id)
    if min(vertex.min(initial=0), mission.min(initial=0), landmark.min(initial=0)) < 0:
        raise UserError("the truth is of another data set: it does not know everything in the map")
    T_G_M = truth.T_G_M[mission]
    of_vertex = T_G_M[vi_map.vertices.mission]
    T_G_I = truth.T_G_I[vertex]
    frames = np.array(vi_map.baseframes.T_G_M)
    frames[vi_map.missions.baseframe] = T_G_M
    p_G = truth.point_G[truth.landmark_point[landmark]]
    return vi_map.replace(
        sensors=_true_sensors(vi_map.sensors, truth),
        baseframes=vi_map.baseframes.replace(T_G_M=frames),
        vertices=vi_map.vertices.replace(
            T_M_I=se3.relative(of_vertex, T_G_I),
            v_M=so3.rotate(so3.inverse(of_vertex[:, :4]), truth.v_G[vertex]),
            accel_bias=truth.accel_bias[vertex],
            gyro_bias=truth.gyro_bias[vertex],
        ),
        landmarks=vi_map.landmarks.replace(
            p_I=se3.transform(se3.inverse(T_G_I[vi_map.landmarks.vertex]), p_G)
        ),
    )


def _true_sensors(sensors: SensorSet, truth: Truth) -> SensorSet:
    imus, cameras = IdIndex(truth.imu_id), IdIndex(truth.camera_id.reshape(-1, 2))
    parameters = truth.camera_parameters.reshape(-1, truth.camera_parameters.shape[-1])
    poses = truth.T_I_C.reshape(-1, 7)
    result = dict(sensors.sensors)
    for sensor_id, sensor in sensors.sensors.items():
        if isinstance(sensor, Imu):
            row = int(imus.rows(from_hex(sensor_id)[None])[0])
            intrinsics = ImuIntrinsics(truth.imu_T_g[row], truth.imu_T_a[row], truth.imu_R_A_I[row])
            result[sensor_id] = dataclasses.replace(sensor, intrinsics=intrinsics)
        elif isinstance(sensor, CameraRig):
            rows = cameras.rows(np.stack([from_hex(camera.id) for camera in sensor.cameras]))
            changed = []
            for camera, row in zip(sensor.cameras, rows, strict=True):
                first = len(camera.intrinsics)
                last = first + len(camera.distortion_parameters)
                changed.append(
                    dataclasses.replace(
                        camera,
                        intrinsics=parameters[row, :first],
                        distortion_parameters=parameters[row, first:last],
                    )
                )
            result[sensor_id] = dataclasses.replace(
                sensor, cameras=tuple(changed), T_B_C=poses[rows]
            )
    return SensorSet(result, sensors.extrinsics, sensors.extra)


def true_poses(
    query: VIMap, localizations: Localizations, database: LocalizationMap, path: Path
) -> tuple[Reference, F64]:
    """Return the true poses of the queries, and T_R_G (7,) from the true poses of the observers.

    Args:
        path: The file truth.npz of `simulate`.

    Raises:
        UserError: The file does not know the queries or the observers, or the map has no ids.
    """
    truth = Truth.load(path)
    index = IdIndex(truth.vertex_id)
    row = index.rows(query.vertices.id[localizations.vertex])
    if not (row >= 0).any():
        raise UserError(f"{path} is of another data set: it knows none of the queries")
    reference = Reference(str(path), truth.T_G_I[row], row >= 0)
    if database.observer_id is None:
        raise UserError("the summary map has no ids: its place in the truth is not known")
    observer = index.rows(database.observer_id)
    known = observer >= 0
    if known.sum() < 3:
        raise UserError(f"{path} is of another data set: it knows none of the map's vertices")
    T_R_G, _ = alignment.umeyama(truth.T_G_I[observer[known], 4:], database.p_G_observer[known])
    return reference, T_R_G
