"""Two calibrations of a device, side by side."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.reports import CalibrationComparison, ComparedParameter
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, Distortion, Projection, SensorSet
from maplab_py.sensors.imu import ImuIntrinsics

F64 = NDArray[np.float64]

_DISTORTION = {
    Distortion.NONE: (),
    Distortion.RADTAN: ("k1", "k2", "p1", "p2"),
    Distortion.EQUIDISTANT: ("k1", "k2", "k3", "k4"),
    Distortion.FOV: ("w",),
}
_PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_NAMES = ("x scale", "y scale", "z scale", "xy misalignment", "xz misalignment", "yz misalignment")


def compare(
    first: SensorSet,
    first_ids: tuple[str, str],
    second: SensorSet,
    second_ids: tuple[str, str],
) -> CalibrationComparison:
    """Compare IMU and rig (ids) of two sets of sensors, parameter by parameter.

    Raises:
        UserError: The cameras are of different models.
    """
    from maplab_py.errors import UserError

    rows, shifts = list[ComparedParameter](), [0.0]
    cameras = [
        s.camera_rig(ids[1]).cameras for s, ids in ((first, first_ids), (second, second_ids))
    ]
    kinds = [[(c.projection, c.distortion) for c in one] for one in cameras]
    if kinds[0] != kinds[1]:
        raise UserError("the calibrations are of different cameras: their number or models differ")
    for row, (a, b) in enumerate(zip(*cameras, strict=True)):
        own = f"camera {row} " if len(cameras[0]) > 1 else "camera "
        rows += _of_cameras(own, a, b)
        shifts.append(pixel_shift(a, b))
    poses = [s.T_I_C(*ids) for s, ids in ((first, first_ids), (second, second_ids))]
    between = se3.relative(poses[0], poses[1])
    turn_deg = np.rad2deg(so3.log(between[:, :4]))
    move_m = poses[1][:, 4:] - poses[0][:, 4:]
    for row in range(len(between)):
        own = f"camera {row} " if len(between) > 1 else "camera "
        for axis, name in enumerate("xyz"):
            values = float(poses[0][row, 4 + axis]), float(poses[1][row, 4 + axis])
            rows.append(_row(f"{own}position {name}", "m", *values))
        for axis, name in enumerate("xyz"):
            rows.append(_row(f"{own}rotation about {name}", "deg", 0.0, float(turn_deg[row, axis])))
    known = [s.imu(ids[0]).intrinsics for s, ids in ((first, first_ids), (second, second_ids))]
    rows += _of_imus(known[0] or ImuIntrinsics(), known[1] or ImuIntrinsics())
    return CalibrationComparison(
        tuple(rows),
        max(shifts),
        float(np.linalg.norm(turn_deg, axis=1).max(initial=0.0)),
        float(np.linalg.norm(move_m, axis=1).max(initial=0.0)),
    )


def pixel_shift(a: Camera, b: Camera) -> float:
    """Return the largest distance [px] between the images of a ray in two cameras, over a grid."""
    from maplab_py.sensors.projection import back_project, project

    u, v = np.meshgrid(np.linspace(0, a.width_px, 17), np.linspace(0, a.height_px, 13))
    uv = np.stack([u.reshape(-1), v.reshape(-1)], axis=1)
    ray, known = back_project(a, uv)
    seen, visible = project(b, ray)
    both = known & visible
    return float(np.linalg.norm(seen[both] - uv[both], axis=1).max(initial=0.0))


def _of_cameras(own: str, a: Camera, b: Camera) -> list[ComparedParameter]:
    names = ["focal length u", "focal length v", "centre u", "centre v"]
    units = ["px"] * 4
    if a.projection is Projection.UNIFIED:
        names, units = ["mirror xi", *names], ["", *units]
    more = _DISTORTION[a.distortion]
    names += [f"distortion {name}" for name in more]
    units += [""] * len(more)
    values = [np.concatenate([c.intrinsics, c.distortion_parameters]).tolist() for c in (a, b)]
    rows = [
        _row(own + name, unit, x, y) for name, unit, x, y in zip(names, units, *values, strict=True)
    ]
    return [*rows, _row(f"{own}image delay", "s", a.image_delay_s, b.image_delay_s)]


def _of_imus(a: ImuIntrinsics, b: ImuIntrinsics) -> list[ComparedParameter]:
    rows = []
    for name, x, y in (("gyroscope", a.T_g, b.T_g), ("accelerometer", a.T_a, b.T_a)):
        rows += [
            _row(f"{name} {what}", "", float(x[place]), float(y[place]))
            for what, place in zip(_NAMES, _PLACES, strict=True)
        ]
    turns = np.rad2deg(so3.log(so3.from_matrix(np.stack([a.R_A_I, b.R_A_I]))))
    for axis, name in enumerate("xyz"):
        values = float(turns[0, axis]), float(turns[1, axis])
        rows.append(_row(f"accelerometer rotation about {name}", "deg", *values))
    return rows


def _row(name: str, unit: str, a: float, b: float) -> ComparedParameter:
    return ComparedParameter(name, unit, a, b, b - a)
