"""Ground truth of a simulated data set, stored separately from the maps."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64, I64, U64
from maplab_py.atomic import replaced_file
from maplab_py.errors import UserError
from maplab_py.input_files import read_npz
from maplab_py.interop.trajectories import Trajectory
from maplab_py.simulation.drift import mission_frame
from maplab_py.simulation.recording import Recording
from maplab_py.simulation.sensors import Device
from maplab_py.simulation.world import World
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import from_hex

STATIONARY_MPS, STATIONARY_RADPS = 1e-3, 1e-3
"""Speed limits below which the body is at rest."""
_MOST_PARAMETERS = 9


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
    camera_parameters: F64  # (M, C, 9) intrinsics, then distortion, then NaN
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
        recording: What was recorded, with the true motion.
        device: With the true calibration.
        world: The world's points.
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
