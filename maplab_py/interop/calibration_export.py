"""Export of calibrations to the formats of other programs, converted exactly.

maplab's model: w = T_g w_I + b_g, a = T_a R_A_I f_I + b_a, both T upper triangular, I = gyroscope frame.
"""

import json
from typing import Any

import numpy as np
import yaml

from maplab_py.array_types import F64, NDArray
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.calibrations import models
from maplab_py.sensors import Camera, Distortion, Imu, Projection, SensorSet, sensors_yaml
from maplab_py.sensors.camera import DISTORTION_NAMES, MIRROR_NAMES
from maplab_py.sensors.imu import ImuIntrinsics


def exported(
    sensors: SensorSet, imu_id: str, rig_id: str, form: str, *, imu_rate_hz: float
) -> dict[str, str]:
    """Return file names and contents.

    Args:
        form: maplab, kalibr, openvins or basalt.
        imu_rate_hz: For the formats that name it.

    Raises:
        UserError: The format does not support a camera model.
        MapError: A sensor is missing.
    """
    imu = sensors.imu(imu_id)
    cameras = sensors.camera_rig(rig_id).cameras
    T_I_C = sensors.T_I_C(imu_id, rig_id)
    if form == "maplab":
        return {"sensors.yaml": sensors_yaml.write_sensors(sensors)}
    if form == "kalibr":
        return _kalibr(imu, cameras, T_I_C, imu_rate_hz)
    if form == "openvins":
        return _openvins(imu, cameras, T_I_C, imu_rate_hz)
    return {"calibration.json": _basalt(imu, cameras, T_I_C, imu_rate_hz)}


def lower_triangular(matrix: NDArray[Any]) -> tuple[F64, F64]:
    """Return L and a rotation R with L R = matrix (3, 3), L lower triangular, diagonal positive."""
    q, r = np.linalg.qr(matrix.T)
    signs = np.where(np.diag(r) < 0.0, -1.0, 1.0)
    return (r * signs[:, None]).T, (q * signs).T


def rotated_lower_triangular(matrix: NDArray[Any]) -> tuple[F64, F64]:
    """Return a rotation R and L with R L = matrix (3, 3), L lower triangular, diagonal positive."""
    flip = np.eye(3)[::-1]
    q, r = np.linalg.qr(matrix @ flip)
    q, lower = q @ flip, flip @ r @ flip
    signs = np.where(np.diag(lower) < 0.0, -1.0, 1.0)
    return q * signs, lower * signs[:, None]


def _known(imu: Imu) -> ImuIntrinsics:
    return imu.intrinsics or ImuIntrinsics()


def _time_shift_s(camera: Camera) -> float:
    """Return t_imu - t_camera [s]."""
    return camera.time_offset_ns * 1e-9 + camera.image_delay_s


def _chain(cameras: tuple[Camera, ...], T_imu_C: F64) -> dict[str, Any]:
    chain: dict[str, Any] = {}
    for row, camera in enumerate(cameras):
        name = models.kalibr_name(models.DISTORTIONS, camera.distortion)
        if not name:
            raise UserError(
                f"kalibr and OpenVINS have no {camera.distortion.value} distortion: maplab and basalt have it"
            )
        chain[f"cam{row}"] = {
            "T_cam_imu": np.linalg.inv(se3.to_matrix(T_imu_C[row])).tolist(),
            "cam_overlaps": [other for other in range(len(cameras)) if other != row],
            "camera_model": models.kalibr_name(models.PROJECTIONS, camera.projection),
            "distortion_coeffs": camera.distortion_parameters.tolist(),
            "distortion_model": name,
            "intrinsics": camera.intrinsics.tolist(),
            "resolution": [camera.width_px, camera.height_px],
            "rostopic": camera.topic or f"/cam{row}/image_raw",
            "timeshift_cam_imu": _time_shift_s(camera),
        }
        if camera.line_delay_ns:
            chain[f"cam{row}"]["line_delay"] = camera.line_delay_ns * 1e-9
    return chain


def _noise(imu: Imu, rate_hz: float) -> dict[str, Any]:
    return {
        "accelerometer_noise_density": imu.acc_noise_density,
        "accelerometer_random_walk": imu.acc_bias_random_walk_noise_density,
        "gyroscope_noise_density": imu.gyro_noise_density,
        "gyroscope_random_walk": imu.gyro_bias_random_walk_noise_density,
        "rostopic": imu.topic or "/imu0",
        "time_offset": 0.0,
        "update_rate": rate_hz,
    }


def _kalibr(imu: Imu, cameras: tuple[Camera, ...], T_I_C: F64, rate_hz: float) -> dict[str, str]:
    """Kalibr's scale-misalignment: a = M_a f_i, w = M_g C_gyro_i w_i, both M lower triangular.

    Its frame i is that in which the accelerometer's matrix is lower triangular, so camera poses
    are given in i.
    """
    known = _known(imu)
    M_a, R_i_I = lower_triangular(known.T_a @ known.R_A_I)
    M_g, C_gyro_i = lower_triangular(known.T_g @ R_i_I.T)
    T_i_I = se3.make(so3.from_matrix(R_i_I), np.zeros(3))
    entry = {
        "T_i_b": np.eye(4).tolist(),
        **_noise(imu, rate_hz),
        "model": "scale-misalignment",
        "accelerometers": {"M": M_a.tolist()},
        "gyroscopes": {
            "M": M_g.tolist(),
            "A": np.zeros((3, 3)).tolist(),
            "C_gyro_i": C_gyro_i.tolist(),
        },
    }
    return {
        "camchain-imucam.yaml": _yaml(_chain(cameras, se3.compose(T_i_I, T_I_C))),
        "imu.yaml": _yaml({"imu0": entry}),
    }


def _openvins(imu: Imu, cameras: tuple[Camera, ...], T_I_C: F64, rate_hz: float) -> dict[str, str]:
    """OpenVINS' model "rpng" equals maplab's: upper triangular, rotation on the accelerometer."""
    for camera in cameras:
        fits = camera.projection is Projection.PINHOLE
        if not fits or camera.distortion not in (Distortion.RADTAN, Distortion.EQUIDISTANT):
            raise UserError(
                f"OpenVINS knows pinhole cameras with radtan or equidistant distortion, not "
                f"{camera.projection.value} with {camera.distortion.value}"
            )
    known = _known(imu)
    entry = {
        "T_i_b": np.eye(4).tolist(),
        **_noise(imu, rate_hz),
        "model": "rpng",
        "Tw": known.T_g.tolist(),
        "R_IMUtoGYRO": np.eye(3).tolist(),
        "Ta": known.T_a.tolist(),
        "R_IMUtoACC": known.R_A_I.tolist(),
        "Tg": np.zeros((3, 3)).tolist(),
    }
    head = "%YAML:1.0\n\n"
    return {
        "kalibr_imucam_chain.yaml": head + _yaml(_chain(cameras, T_I_C)),
        "kalibr_imu_chain.yaml": head + _yaml({"imu0": entry}),
    }


def _basalt(imu: Imu, cameras: tuple[Camera, ...], T_I_C: F64, rate_hz: float) -> str:
    """Basalt corrects: f_i = (1 + S_a) a - b_a with S_a lower triangular, w_i = (1 + S_g) w - b_g.

    Its frame i is that in which the accelerometer's correction is lower triangular.
    """
    known = _known(imu)
    R_I_i, L = rotated_lower_triangular(np.linalg.inv(known.T_a @ known.R_A_I))
    S_a = L - np.eye(3)
    S_g = R_I_i.T @ np.linalg.inv(known.T_g) - np.eye(3)
    T_i_C = se3.compose(se3.make(so3.from_matrix(R_I_i.T), np.zeros(3)), T_I_C)
    names = ("qx", "qy", "qz", "qw", "px", "py", "pz")
    lower = [*S_a[:, 0], S_a[1, 1], S_a[2, 1], S_a[2, 2]]
    content = {
        "T_imu_cam": [dict(zip(names, map(float, pose), strict=True)) for pose in T_i_C],
        "intrinsics": [_basalt_camera(camera) for camera in cameras],
        "resolution": [[camera.width_px, camera.height_px] for camera in cameras],
        "calib_accel_bias": [0.0, 0.0, 0.0, *map(float, lower)],
        "calib_gyro_bias": [0.0, 0.0, 0.0, *map(float, S_g.T.reshape(-1))],
        "imu_update_rate": rate_hz,
        "accel_noise_std": [imu.acc_noise_density] * 3,
        "gyro_noise_std": [imu.gyro_noise_density] * 3,
        "accel_bias_std": [imu.acc_bias_random_walk_noise_density] * 3,
        "gyro_bias_std": [imu.gyro_bias_random_walk_noise_density] * 3,
        "T_mocap_world": dict(zip(names, map(float, se3.identity()), strict=True)),
        "T_imu_marker": dict(zip(names, map(float, se3.identity()), strict=True)),
        "mocap_time_offset_ns": 0,
        "mocap_to_imu_offset_ns": 0,
        "cam_time_offset_ns": round(_time_shift_s(cameras[0]) * 1e9),
        "vignette": [],
    }
    return json.dumps({"value0": content}, indent=2) + "\n"


_BASALT_DISTORTIONS = {
    Distortion.NONE: "pinhole",
    Distortion.EQUIDISTANT: "kb4",
    Distortion.RADTAN: "pinhole-radtan8",
    Distortion.RADTAN5: "pinhole-radtan8",
    Distortion.RATIONAL: "pinhole-radtan8",
    Distortion.FOV: "fov",
}
_BASALT_PROJECTIONS = {
    Projection.UNIFIED: "ucm",
    Projection.DOUBLE_SPHERE: "ds",
    Projection.EXTENDED_UNIFIED: "eucm",
}


def _basalt_camera(camera: Camera) -> dict[str, Any]:
    values = dict(zip(("fx", "fy", "cx", "cy"), map(float, camera.intrinsics[-4:]), strict=True))
    if camera.projection is Projection.PINHOLE:
        kind = _BASALT_DISTORTIONS[camera.distortion]
        parameters = camera.distortion_parameters
        values.update(zip(DISTORTION_NAMES[camera.distortion], map(float, parameters), strict=True))
        if kind == "pinhole-radtan8":
            more = ("k3", "k4", "k5", "k6", "rpmax")
            values = {**values, **{key: values.get(key, 0.0) for key in more}}
        return {"camera_type": kind, "intrinsics": values}
    if camera.distortion is not Distortion.NONE:
        raise UserError(
            f"Basalt has no camera model for {camera.projection.value} with "
            f"{camera.distortion.value} distortion"
        )
    mirror = dict(
        zip(MIRROR_NAMES[camera.projection], map(float, camera.intrinsics[:-4]), strict=True)
    )
    if (
        camera.projection is Projection.UNIFIED
    ):  # xi = alpha / (1 - alpha), focal lengths f (1 - alpha)
        alpha = mirror["xi"] / (1.0 + mirror["xi"])
        mirror = {"alpha": alpha}
        values = {**values, "fx": values["fx"] * (1.0 - alpha), "fy": values["fy"] * (1.0 - alpha)}
    return {"camera_type": _BASALT_PROJECTIONS[camera.projection], "intrinsics": values | mirror}


def _yaml(value: dict[str, Any]) -> str:
    return yaml.safe_dump(value, default_flow_style=None, sort_keys=False, width=100)
