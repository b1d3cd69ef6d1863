"""Estimated calibration parameters with names, values and standard deviations."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.vi_optimization.map_problem import MapProblem
from maplab_py.algorithms.vi_optimization.reports import CalibratedParameter
from maplab_py.errors import EstimationError
from maplab_py.estimation.blocks import Manifold, ParameterBlock
from maplab_py.estimation.problem.marginals import Marginals
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.cameras import EXTRINSICS, INTRINSICS, TIMING
from maplab_py.estimation.terms.inertial_calibration import ACCEL, GYRO, ROTATION
from maplab_py.estimation.terms.pose import MOUNTING
from maplab_py.estimation.terms.wheel import WHEEL_SCALE
from maplab_py.sensors.camera import DISTORTION_NAMES, MIRROR_NAMES

_MATRIX = ["[0,0]", "[1,1]", "[2,2]", "[0,1]", "[0,2]", "[1,2]"]
_ROTATION = ["rotation x [rad]", "rotation y [rad]", "rotation z [rad]"]
_OF_CAMERAS = (INTRINSICS, EXTRINSICS, TIMING)
_POSE = ["x [m]", "y [m]", "z [m]", *_ROTATION]


def calibration_rows(map_problem: MapProblem, after: States) -> list[CalibratedParameter]:
    """Return a row for every calibration parameter that was estimated."""
    names = [
        name
        for name in (INTRINSICS, EXTRINSICS, TIMING, GYRO, ACCEL, ROTATION, MOUNTING, WHEEL_SCALE)
        if name in after.blocks and map_problem.problem.can_move(after.nodes(name)).any()
    ]
    if not names:
        return []
    try:
        marginals: Marginals | None = Marginals(map_problem.problem, after)
    except EstimationError:
        marginals = None
    rows: list[CalibratedParameter] = []
    for name in names:
        rows += _rows_of(map_problem, after, name, marginals)
    return rows


def _rows_of(
    map_problem: MapProblem, after: States, name: str, marginals: Marginals | None
) -> list[CalibratedParameter]:
    block, before = after.blocks[name], map_problem.states.blocks[name]
    is_free = map_problem.problem.can_move(after.nodes(name)).reshape(len(block), -1)
    change = block.difference(before.values)
    sigma = np.full(change.shape, np.nan)
    if marginals is not None:
        if name in _OF_CAMERAS and map_problem.problem.visual is not None:
            sigma = marginals.robust_sigma(name)
        else:
            sigma = np.sqrt(np.maximum(np.diag(marginals.block(name)), 0.0)).reshape(change.shape)
    rows = []
    for row, column in np.argwhere(is_free[:, : block.dimension]):
        start = before.values[row, column] if block.manifold is Manifold.VECTOR else 0.0
        label = f"{_owner(map_problem, name, int(row))} {parameter_names(map_problem, block)[row][column]}"
        rows.append(
            CalibratedParameter(
                label,
                float(start),
                float(start + change[row, column]),
                float(sigma[row, column]),
            )
        )
    return rows


def parameter_names(map_problem: MapProblem, block: ParameterBlock) -> list[list[str]]:
    """Return the names of the parameters of each row of a block."""
    if block.name in (EXTRINSICS, MOUNTING):
        return [_POSE] * len(block)
    if block.name == ROTATION:
        return [[f"R_AI {axis}" for axis in _ROTATION]] * len(block)
    if block.name in (GYRO, ACCEL):
        matrix = "T_g" if block.name == GYRO else "T_a"
        return [[matrix + place for place in _MATRIX]] * len(block)
    if block.name == WHEEL_SCALE:
        return [["scale, reported / driven distance"]] * len(block)
    if block.name == TIMING:
        return [["image delay [s]", "line delay [s]"]] * len(block)
    assert map_problem.rig is not None
    names = []
    for row in range(len(block)):
        projection, distortion = map_problem.rig.models[row]
        pinhole = ["fu [px]", "fv [px]", "cu [px]", "cv [px]"]
        names.append([*MIRROR_NAMES[projection], *pinhole, *DISTORTION_NAMES[distortion]])
    return names


def _owner(map_problem: MapProblem, name: str, row: int) -> str:
    if name in (GYRO, ACCEL, ROTATION):
        return f"IMU {map_problem.factors.imus[row].id[:8]}"
    if name == WHEEL_SCALE:
        return f"wheel sensor {map_problem.factors.wheels[row][:8]}"
    if name == MOUNTING:
        return f"sensor {map_problem.factors.mounted.owner[row][1][:8]}"
    assert map_problem.rig is not None
    _, rig_id, camera = map_problem.rig.owner[row]
    camera_id = map_problem.vi_map.sensors.camera_rig(rig_id).cameras[camera].id
    place = "on IMU " if name == EXTRINSICS else ""
    return f"camera {camera_id[:8]} {place}".rstrip()
