"""Measurements for counterparts of tables 6.1 to 7.5 of Schneider 2019, in four environments and two uses."""

import dataclasses
import sys
import time
from pathlib import Path

import numpy as np

from maplab_py.algorithms.self_calibration.device import transfer_calibration
from maplab_py.geometry import so3
from maplab_py.sensors import SensorSet
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SimulatedData
from maplab_py.simulation.truth import true_map
from studies.accuracy import DataSet, calibrate_segments
from studies.data_sets import (
    OPTIONS,
    Row,
    append_line,
    data_set,
    evaluation_session,
    lines_of,
    true_problem,
)
from studies.joint_ekf import filter_jointly
from studies.odometry import odometry_errors, sensors_with

BATCH, FILTER = "batch", "joint EKF"
"""The filter is measured after the batch: it has the batch's intrinsics, as in the thesis."""
METHODS = (BATCH, "8: E-optimality", "8: D-optimality", "8: A-optimality", "8: random", FILTER)
PAPER_III_METHODS = ("informative", "8 each: entropy by groups", "information gain")
"""Also measured in the office room, for tables 6.1 to 6.3."""
OFFICE_ROOM, CLASS_ROOM = "AR/VR: office room", "AR/VR: class room"
GARAGE, OFFICE_BUILDING = "navigation: parking garage", "navigation: office building"
PER_GROUP = 8
EVALUATION_SEEDS = (9, 19)


def environments() -> dict[str, Scenario]:
    """Return the scenario of every environment of table 7.2; the device is the same in all."""
    office, rooms = load_scenario("ar_room"), load_scenario("navigation")
    class_room = dataclasses.replace(
        office.world, room_size_m=(13.0, 10.0, 3.2), landmarks_per_room=6000
    )
    garage = dataclasses.replace(
        rooms.world,
        rooms=2,
        room_size_m=(20.0, 15.0, 2.6),
        landmarks_per_room=5000,
        furniture_per_room=2,
        bare_share=0.6,
    )
    return {
        OFFICE_ROOM: office,
        CLASS_ROOM: dataclasses.replace(office, world=class_room),
        GARAGE: dataclasses.replace(rooms, world=garage),
        OFFICE_BUILDING: load_scenario("straight_walks"),
    }


def measure(scenarios: dict[str, Scenario], sets: range, out: Path) -> None:
    """Calibrate every session with every method, and run odometry with the results.

    Sessions of all environments are measured in turn, so that a file of a study that was interrupted
    has as many of each.

    Args:
        scenarios: Scenario of every environment; the first is the office room.
        sets: Numbers of the sessions.
        out: Output file, a line per result; results that it contains are not measured again.
    """
    office = next(iter(scenarios.values()))
    judges = [evaluation_session(office, seed) for seed in EVALUATION_SEEDS]
    for number in sets:
        for environment, scenario in scenarios.items():
            methods = METHODS + (PAPER_III_METHODS if scenario is office else ())
            rows = {
                row["method"]: row
                for row in lines_of(out)
                if (row["environment"], row["set"]) == (environment, number)
            }
            missing = [method for method in ("session", "nominal", *methods) if method not in rows]
            if not missing:
                continue
            data = DataSet.of(scenario, number)
            for method in missing:
                row = {"environment": environment, **_row(scenario, data, method, rows)}
                if method != "session":
                    row |= _judged(judges, row["error"])
                append_line(out, row)
                rows[method] = row
                sys.stdout.write(f"{number} {environment:27s} {method:26s} {row.get('vio_m')}\n")
                sys.stdout.flush()


def _row(scenario: Scenario, data: DataSet, method: str, rows: dict[str, Row]) -> Row:
    if method == "session":
        return {"set": data.number, **_characteristics(data_set(scenario, data.number))}
    if method == "nominal":
        error = data.nominal_error.tolist()
        return {"set": data.number, "method": method, "names": list(data.names), "error": error}
    if method == FILTER:
        return _filtered(scenario, data, rows[BATCH])
    return calibrate_segments(scenario, data, method, PER_GROUP)


def _characteristics(data: SimulatedData) -> Row:
    """Return length [m], duration [s] and mean angular velocity [deg/s] of a session."""
    v, T_G_I = data.maps[0].vertices, true_map(data.maps[0], data.truth).T_G_I
    seconds = 1e-9 * float(v.timestamp_ns[-1] - v.timestamp_ns[0])
    q = T_G_I[:, :4]
    turned = np.linalg.norm(so3.log(so3.multiply(so3.inverse(q[:-1]), q[1:])), axis=1).sum()
    length_m = np.linalg.norm(np.diff(T_G_I[:, 4:], axis=0), axis=1).sum()
    return {
        "method": "session",
        "length_m": float(length_m),
        "duration_s": seconds,
        "angular_degps": float(np.rad2deg(turned)) / seconds,
    }


def _filtered(scenario: Scenario, data: DataSet, batch: Row) -> Row:
    """Return the errors after the joint filter, which has the batch's intrinsics."""
    error, intrinsic = data.nominal_error.copy(), _intrinsic(data.names)
    error[intrinsic] = np.array(batch["error"])[intrinsic]
    sensors: SensorSet = sensors_with(true_problem(data_set(scenario, data.number)), error)
    began = time.process_time()
    joint = filter_jointly(transfer_calibration(data.vi_map, sensors), OPTIONS)
    rows = [data.names.index(name) for name in joint.parameters.names]
    error[rows] = joint.parameters.difference(joint.blocks, data.truth)
    return {
        "set": data.number,
        "method": FILTER,
        "names": list(data.names),
        "error": error.tolist(),
        "cpu_s": time.process_time() - began,
        "images": len(data.vi_map.vertices),
    }


def _intrinsic(names: tuple[str, ...]) -> list[int]:
    kinds = ("focal", "centre", "distortion")
    return [row for row, name in enumerate(names) if name.split()[1] in kinds]


def _judged(judges: list[SimulatedData], error: list[float]) -> Row:
    """Return the errors [m], [deg] of odometry with a calibration over the evaluation sessions."""
    each = [odometry_errors(s, sensors_with(true_problem(s), np.array(error))) for s in judges]
    return {"vio_m": [m for m, _ in each], "vio_deg": [degrees for _, degrees in each]}
