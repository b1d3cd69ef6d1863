"""Comparison of two calibrations of a device, parameter by parameter."""

import numpy as np

from maplab_py.algorithms.self_calibration.reports import CalibrationComparison, ComparedParameter
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, SensorSet, calibration_transfer, camera, imu, projection


def compare(
    first: SensorSet,
    first_device: calibration_transfer.Device,
    second: SensorSet,
    second_device: calibration_transfer.Device,
) -> CalibrationComparison:
    """Compare the calibrations of two devices.

    Raises:
        UserError: The cameras are of different models.
    """
    pairs = ((first, first_device), (second, second_device))
    rigs = [sensors.camera_rig(device.rig) for sensors, device in pairs]
    if calibration_transfer.camera_models(rigs[0]) != calibration_transfer.camera_models(rigs[1]):
        raise UserError("the calibrations are of different cameras: their number or models differ")
    prefixes = ["camera "]
    if len(rigs[0].cameras) > 1:
        prefixes = [f"camera {row} " for row in range(len(rigs[0].cameras))]
    cameras = list(zip(prefixes, rigs[0].cameras, rigs[1].cameras, strict=True))
    T_I_C = [sensors.T_I_C(*device) for sensors, device in pairs]
    turn_deg = np.rad2deg(so3.log(se3.relative(T_I_C[0], T_I_C[1])[:, :4]))
    shift_m = T_I_C[1][:, 4:] - T_I_C[0][:, 4:]
    rows = [row for prefix, a, b in cameras for row in _camera_rows(prefix, a, b)]
    for k, prefix in enumerate(prefixes):
        for axis, name in enumerate("xyz"):
            a, b = (float(poses[k, 4 + axis]) for poses in T_I_C)
            rows.append(_row(f"{prefix}position {name}", "m", a, b))
        for axis, name in enumerate("xyz"):
            rows.append(
                _row(f"{prefix}rotation about {name}", "deg", 0.0, float(turn_deg[k, axis]))
            )
    imus = [sensors.imu(device.imu).intrinsics or imu.ImuIntrinsics() for sensors, device in pairs]
    return CalibrationComparison(
        (*rows, *_imu_rows(*imus)),
        max((pixel_shift(a, b) for _, a, b in cameras), default=0.0),
        float(np.linalg.norm(turn_deg, axis=1).max(initial=0.0)),
        float(np.linalg.norm(shift_m, axis=1).max(initial=0.0)),
    )


def pixel_shift(a: Camera, b: Camera) -> float:
    """Return the largest distance [px] between the images of a ray in two cameras, over a grid."""
    u, v = np.meshgrid(np.linspace(0, a.width_px, 17), np.linspace(0, a.height_px, 13))
    uv = np.stack([u.reshape(-1), v.reshape(-1)], axis=1)
    ray, is_known = projection.back_project(a, uv)
    projected, is_visible = projection.project(b, ray)
    both = is_known & is_visible
    return float(np.linalg.norm(projected[both] - uv[both], axis=1).max(initial=0.0))


def _camera_rows(prefix: str, a: Camera, b: Camera) -> list[ComparedParameter]:
    values = [np.concatenate([c.intrinsics, c.distortion_parameters]).tolist() for c in (a, b)]
    rows = [
        _row(prefix + name, unit, x, y)
        for (name, unit), x, y in zip(
            camera.parameter_names(a.projection, a.distortion), *values, strict=True
        )
    ]
    rows.append(_row(f"{prefix}image delay", "s", a.image_delay_s, b.image_delay_s))
    if a.line_delay_ns or b.line_delay_ns:
        line_delays_s = (1e-9 * a.line_delay_ns, 1e-9 * b.line_delay_ns)
        rows.append(_row(f"{prefix}line delay", "s", *line_delays_s))
    return rows


def _imu_rows(a: imu.ImuIntrinsics, b: imu.ImuIntrinsics) -> list[ComparedParameter]:
    rows = [
        _row(f"{sensor} {name}", "", float(x[place]), float(y[place]))
        for sensor, x, y in (("gyroscope", a.T_g, b.T_g), ("accelerometer", a.T_a, b.T_a))
        for name, place in imu.TRIANGLE_NAMES.items()
    ]
    turns_deg = np.rad2deg(so3.log(so3.from_matrix(np.stack([a.R_A_I, b.R_A_I])))).tolist()
    for axis, x, y in zip("xyz", *turns_deg, strict=True):
        rows.append(_row(f"accelerometer rotation about {axis}", "deg", x, y))
    return rows


def _row(name: str, unit: str, a: float, b: float) -> ComparedParameter:
    return ComparedParameter(name, unit, a, b, b - a)
