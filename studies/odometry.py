"""Errors of visual-inertial odometry with calibrations that `accuracy` has measured.

Schneider 2019 evaluates a calibration by the error of odometry that uses it. Here the joint filter
runs over the evaluation session with a fixed calibration: a window of 20 poses, no loop closures.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np

from maplab_py.algorithms.self_calibration.device import transfer_calibration
from maplab_py.algorithms.self_calibration.estimation.problem import SegmentProblem
from maplab_py.algorithms.vi_optimization.solution import with_estimated_sensors
from maplab_py.array_types import F64
from maplab_py.geometry import alignment, se3, so3
from maplab_py.sensors import SensorSet
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.simulate import SimulatedData
from maplab_py.vimap.ids import IdIndex
from studies.data_sets import (
    OPTIONS,
    append_line,
    evaluation_session,
    lines_of,
    problem_of,
    true_problem,
)
from studies.joint_ekf import filter_jointly

_FIXED = dataclasses.replace(OPTIONS, states="extrinsics_rotation", prior_rotation_deg=1e-6)
"""Prior of the rotation that the filter estimates: a millionth of a degree, effectively fixed."""


def measure_odometry(scenario: Scenario, results: Path, methods: list[str], out: Path) -> None:
    """Append the error of odometry with every calibration in a file of results.

    Args:
        scenario: Scenario of the results.
        results: File of `accuracy.measure`.
        methods: Methods whose calibrations are used.
        out: Output file; results that it contains are not measured again.
    """
    session = evaluation_session(scenario)
    true, nominal = true_problem(session), problem_of(session.maps[0])
    blocks = nominal.states.blocks, true.states.blocks
    nominal_error = nominal.parameters.difference(*blocks)
    rows = [
        {"set": -1, "method": "truth", "error": np.zeros(len(nominal_error))},
        {"set": -1, "method": "nominal", "error": nominal_error},
        *(row for row in lines_of(results) if row["set"] >= 0 and row["method"] in methods),
    ]
    done = {(row["set"], row["method"]) for row in lines_of(out)}
    for row in rows:
        number, method = row["set"], row["method"]
        if (number, method) in done:
            continue
        error_m, _ = odometry_errors(session, sensors_with(true, np.array(row["error"])))
        append_line(out, {"set": number, "method": method, "vio_m": error_m})
        sys.stdout.write(f"{number:3d} {method:26s} {error_m:.4f} m\n")
        sys.stdout.flush()


def sensors_with(true: SegmentProblem, error: F64) -> SensorSet:
    """Return the true calibration changed by an error (k,) of its parameters."""
    states = true.states
    node, direction = true.parameters.nodes(states)
    step = np.zeros((states.blocks.num_nodes, 3))
    step[node - states.num_vertex_nodes, direction] = error
    moved = dataclasses.replace(states, blocks=states.blocks.moved(step))
    return with_estimated_sensors(true, moved)


def odometry_errors(session: SimulatedData, sensors: SensorSet) -> tuple[float, float]:
    """Return the root mean square errors [m], [deg] of the filter with a fixed calibration."""
    vi_map = transfer_calibration(session.maps[0], sensors)
    T_G_I = filter_jointly(vi_map, _FIXED).T_G_I
    row = IdIndex(session.truth.vertex_id).rows(vi_map.vertices.id)
    T_true = session.truth.T_G_I[row]
    T_aligned = se3.compose(alignment.align_yaw_position(T_true[:, 4:], T_G_I[:, 4:]), T_G_I)
    turned = so3.log(so3.multiply(so3.inverse(T_true[:, :4]), T_aligned[:, :4]))
    squares = (np.sum(each**2, axis=1) for each in (T_aligned[:, 4:] - T_true[:, 4:], turned))
    metres, radians = (float(np.sqrt(np.mean(each))) for each in squares)
    return metres, float(np.rad2deg(radians))
