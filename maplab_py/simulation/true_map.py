"""Simulated map with all states set to their true values."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.sensors import CameraRig, Imu, ImuIntrinsics, SensorSet
from maplab_py.simulation.truth import Truth
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import IdIndex, from_hex


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
