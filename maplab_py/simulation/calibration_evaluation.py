"""Calibration errors of the sensors of a map against the simulated devices."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import so3
from maplab_py.sensors import ImuIntrinsics
from maplab_py.simulation.truth import Truth
from maplab_py.vimap import MissionSensor, VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.queries import mission_sensor_id


@dataclasses.dataclass(frozen=True)
class CalibrationError:
    """Largest deviations of a mission's sensors from the truth, over its cameras and axes."""

    mission: str  # beginning of its id
    focal_px: float
    centre_px: float
    distortion: float
    camera_rotation_deg: float
    camera_position_m: float
    gyro_scale: float
    gyro_misalignment: float
    accel_scale: float
    accel_misalignment: float
    accel_rotation_deg: float


def calibration_errors(
    vi_map: VIMap, truth: Truth, missions: NDArray[np.int64]
) -> tuple[CalibrationError, ...]:
    """Compare the sensors of every mission with the truth.

    Args:
        vi_map: The map.
        truth: The truth.
        missions: Row (M,) of the truth's missions for each mission of the map, -1 = unknown.
    """
    return tuple(
        _of_mission(vi_map, truth, number, row)
        for number, row in enumerate(missions.tolist())
        if row >= 0 and _has_sensors(vi_map, number)
    )


def _has_sensors(vi_map: VIMap, mission: int) -> bool:
    try:
        for sensor in (MissionSensor.IMU, MissionSensor.NCAMERA):
            mission_sensor_id(vi_map, mission, sensor)
    except MapError:
        return False
    return True


def _of_mission(vi_map: VIMap, truth: Truth, mission: int, row: int) -> CalibrationError:
    imu_id = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
    rig_id = mission_sensor_id(vi_map, mission, MissionSensor.NCAMERA)
    imu = vi_map.sensors.imu(imu_id).intrinsics or ImuIntrinsics()
    T_I_C, true_T_I_C = vi_map.sensors.T_I_C(imu_id, rig_id), truth.T_I_C[row]
    deviations = []
    for camera, true in zip(
        vi_map.sensors.camera_rig(rig_id).cameras, truth.camera_parameters[row], strict=True
    ):
        first = len(camera.intrinsics)
        last = first + len(camera.distortion_parameters)
        intrinsics = np.abs(camera.intrinsics - true[:first])
        distortion = np.abs(camera.distortion_parameters - true[first:last])
        deviations.append(
            [intrinsics[-4:-2].max(), intrinsics[-2:].max(), distortion.max(initial=0.0)]
        )
    focal, centre, distortion_error = np.max(deviations, axis=0)
    gyro, accel = imu.T_g - truth.imu_T_g[row], imu.T_a - truth.imu_T_a[row]
    above = np.triu_indices(3, 1)
    return CalibrationError(
        mission=to_hex(vi_map.missions.id[mission])[:8],
        focal_px=float(focal),
        centre_px=float(centre),
        distortion=float(distortion_error),
        camera_rotation_deg=_largest_angle(T_I_C[:, :4], true_T_I_C[:, :4]),
        camera_position_m=float(np.linalg.norm(T_I_C[:, 4:] - true_T_I_C[:, 4:], axis=1).max()),
        gyro_scale=float(np.abs(np.diag(gyro)).max()),
        gyro_misalignment=float(np.abs(gyro[above]).max()),
        accel_scale=float(np.abs(np.diag(accel)).max()),
        accel_misalignment=float(np.abs(accel[above]).max()),
        accel_rotation_deg=_largest_angle(
            so3.from_matrix(imu.R_A_I)[None], so3.from_matrix(truth.imu_R_A_I[row])[None]
        ),
    )


def _largest_angle(q: F64, q_true: F64) -> float:
    turn = so3.log(so3.multiply(so3.inverse(q_true), q))
    return float(np.rad2deg(np.linalg.norm(turn, axis=1).max()))
