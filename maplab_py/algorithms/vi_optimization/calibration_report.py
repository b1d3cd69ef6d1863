"""Estimated calibration parameters with names, values and standard deviations."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.vi_optimization.building import PosedProblem
from maplab_py.algorithms.vi_optimization.report import CalibratedParameter
from maplab_py.errors import EstimationError
from maplab_py.estimation.blocks import Manifold, ParameterBlock
from maplab_py.estimation.camera_terms import EXTRINSICS, INTRINSICS, TIME_OFFSET
from maplab_py.estimation.imu_calibration_terms import ACCEL, GYRO, ROTATION
from maplab_py.estimation.marginals import Marginals
from maplab_py.estimation.pose_terms import MOUNTING
from maplab_py.estimation.states import States
from maplab_py.sensors import Distortion, Projection

_MATRIX = ["[0,0]", "[1,1]", "[2,2]", "[0,1]", "[0,2]", "[1,2]"]
_ROTATION = ["rotation x [rad]", "rotation y [rad]", "rotation z [rad]"]
_POSE = ["x [m]", "y [m]", "z [m]", *_ROTATION]
_DISTORTION = {
    Distortion.NONE: [],
    Distortion.RADTAN: ["k1", "k2", "p1", "p2"],
    Distortion.EQUIDISTANT: ["k1", "k2", "k3", "k4"],
    Distortion.FOV: ["w"],
}


def calibration_rows(posed: PosedProblem, after: States) -> list[CalibratedParameter]:
    """Return a row for every calibration parameter that was free; none when none was."""
    names = [
        name
        for name in (INTRINSICS, EXTRINSICS, TIME_OFFSET, GYRO, ACCEL, ROTATION, MOUNTING)
        if name in after.blocks and posed.problem.can_move(after.nodes(name)).any()
    ]
    if not names:
        return []
    try:
        marginals: Marginals | None = Marginals(posed.problem, after)
    except EstimationError:
        marginals = None
    rows: list[CalibratedParameter] = []
    for name in names:
        rows += _rows_of(posed, after, name, marginals)
    return rows


def _rows_of(
    posed: PosedProblem, after: States, name: str, marginals: Marginals | None
) -> list[CalibratedParameter]:
    block, before = after.blocks[name], posed.states.blocks[name]
    is_free = posed.problem.can_move(after.nodes(name)).reshape(len(block), -1)
    change = block.difference(before.values)
    sigma = np.full(change.shape, np.nan)
    if marginals is not None:
        sigma = np.sqrt(np.maximum(np.diag(marginals.block(name)), 0.0)).reshape(change.shape)
    rows = []
    for row, column in np.argwhere(is_free[:, : block.dimension]):
        start = before.values[row, column] if block.manifold is Manifold.VECTOR else 0.0
        label = f"{_owner(posed, name, int(row))} {parameter_names(posed, block)[row][column]}"
        rows.append(
            CalibratedParameter(
                label,
                float(start),
                float(start + change[row, column]),
                float(sigma[row, column]),
            )
        )
    return rows


def parameter_names(posed: PosedProblem, block: ParameterBlock) -> list[list[str]]:
    """Return the names of the parameters of each row of a block."""
    if block.name in (EXTRINSICS, MOUNTING):
        return [_POSE] * len(block)
    if block.name == ROTATION:
        return [[f"R_AI {axis}" for axis in _ROTATION]] * len(block)
    if block.name in (GYRO, ACCEL):
        matrix = "T_g" if block.name == GYRO else "T_a"
        return [[matrix + place for place in _MATRIX]] * len(block)
    if block.name == TIME_OFFSET:
        return [["image delay [s]"]] * len(block)
    assert posed.rig is not None
    names = []
    for row in range(len(block)):
        projection, distortion = posed.rig.models[int(posed.rig.cameras.parameters[row, 0])]
        own = ["fu [px]", "fv [px]", "cu [px]", "cv [px]"]
        own = ["xi", *own] if projection is Projection.UNIFIED else own
        names.append([*own, *_DISTORTION[distortion]])
    return names


def _owner(posed: PosedProblem, name: str, row: int) -> str:
    if name in (GYRO, ACCEL, ROTATION):
        return f"IMU {posed.factors.imus[row].id[:8]}"
    if name == MOUNTING:
        return f"sensor {posed.factors.mounted.owner[row][1][:8]}"
    assert posed.rig is not None
    _, rig_id, camera = posed.rig.owner[row]
    camera_id = posed.vi_map.sensors.camera_rig(rig_id).cameras[camera].id
    place = "on IMU " if name == EXTRINSICS else ""
    return f"camera {camera_id[:8]} {place}".rstrip()
