"""Judge calibrations that evaluate_self_calibration.py measured by odometry on another session.

python docs/scripts/evaluate_calibrated_odometry.py --results=ar_room.jsonl --out=ar_room_vio.jsonl

The thesis judges a calibration by the error of visual-inertial odometry that uses it. Here the joint
filter runs over the evaluation session with the calibration held: a window of 20 poses, no loops, no
map. Appends a line per data set and method, and goes on where it stopped.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np
from evaluate_self_calibration import (
    F64,
    OPTIONS,
    append_line,
    evaluation_session,
    lines_of,
)

from maplab_py.algorithms.self_calibration.joint_ekf import filter_jointly
from maplab_py.algorithms.self_calibration.problem import SegmentProblem, pose
from maplab_py.algorithms.self_calibration.workflow import applied
from maplab_py.algorithms.vi_optimization.writing_back import with_estimated_sensors
from maplab_py.geometry import se3
from maplab_py.geometry.alignment import align_yaw_position
from maplab_py.sensors import SensorSet
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SimulatedData
from maplab_py.simulation.true_map import true_map
from maplab_py.vimap.ids import IdIndex

METHODS = ("informative", "batch", "8: A-optimality", "8: random", "8: least informative")
HELD = dataclasses.replace(OPTIONS, states="extrinsics_rotation", prior_rotation_deg=1e-6)
"""The filter must estimate something: a rotation that is known to a millionth of a degree."""


def sensors_with(true: SegmentProblem, error: F64) -> SensorSet:
    """Return the true calibration changed by an error (k,) of its parameters."""
    states = true.posed.states
    node, direction = true.parameters.nodes(states)
    step = np.zeros((states.blocks.num_nodes, 3))
    step[node - states.num_vertex_nodes, direction] = error
    moved = dataclasses.replace(states, blocks=states.blocks.moved(step))
    return with_estimated_sensors(true.posed, moved)


def odometry_error_m(session: SimulatedData, sensors: SensorSet) -> float:
    """Return the position error [m], root mean square, of the filter with a calibration held."""
    vi_map = applied(session.maps[0], sensors)
    found = filter_jointly(vi_map, HELD).T_G_I[:, 4:]
    row = IdIndex(session.truth.vertex_id).rows(vi_map.vertices.id)
    p_true = session.truth.T_G_I[row, 4:]
    aligned = se3.transform(align_yaw_position(p_true, found), found)
    return float(np.sqrt(np.mean(np.sum((aligned - p_true) ** 2, axis=1))))


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="ar_room")
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    session = evaluation_session(load_scenario(arguments.scenario))
    true = pose(true_map(session.maps[0], session.truth), OPTIONS, robust=False)
    nominal = pose(session.maps[0], OPTIONS, robust=False)
    off = nominal.parameters.difference(nominal.posed.states.blocks, true.posed.states.blocks)
    rows = [
        {"set": -1, "method": "truth", "error": np.zeros(len(off))},
        {"set": -1, "method": "nominal", "error": off},
        *(one for one in lines_of(arguments.results) if one["set"] >= 0),
    ]
    done = {(one["set"], one["method"]) for one in lines_of(arguments.out)}
    for one in rows:
        key = one["set"], one["method"]
        if key in done or (one["set"] >= 0 and one["method"] not in arguments.methods.split(",")):
            continue
        error_m = odometry_error_m(session, sensors_with(true, np.array(one["error"])))
        append_line(arguments.out, {"set": key[0], "method": key[1], "vio_m": error_m})
        sys.stdout.write(f"{key[0]:3d} {key[1]:26s} {error_m:.4f} m\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
