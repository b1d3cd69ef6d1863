"""Simulated sessions of one device with known truth, and files of results."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from maplab_py.algorithms.self_calibration.estimation import problem
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.output_files import write_text
from maplab_py.simulation.scenario import MotionOptions, Scenario, SessionOptions, WorldOptions
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.simulation.truth import true_map
from maplab_py.vimap import VIMap

Row = dict[str, Any]

OPTIONS = SelfCalibrationOptions(keep_unobservable_at_prior=True)
_IMU_NOISE = ("gyro_noise_density", "accel_noise_density", "gyro_bias_walk", "accel_bias_walk")

SHORT = SessionOptions(
    phases=(
        MotionOptions(
            kind="room_scan", duration_s=10.0, turns=0.2, wall_distance_m=2.6, height_m=1.4
        ),
        MotionOptions(
            kind="figure_8",
            duration_s=10.0,
            turns=0.25,
            wall_distance_m=2.6,
            shake_m=0.06,
            shake_rad=0.15,
        ),
        MotionOptions(kind="hover", duration_s=6.0, shake_m=0.08, shake_rad=0.3),
    )
)
"""A session that excites all parameters, short enough for many seeds."""


def data_set(scenario: Scenario, number: int) -> SimulatedData:
    """Simulate a session of the same device with different motion, noise and appearance."""
    session = scenario.sessions[number % len(scenario.sessions)]
    seeds = dataclasses.replace(
        scenario.seeds, motion=100 + number, measurement=200 + number, appearance=300 + number
    )
    return simulate(dataclasses.replace(scenario, seeds=seeds, sessions=(session,)))


def evaluation_session(scenario: Scenario, seed: int = 9) -> SimulatedData:
    """Simulate the session that evaluates calibrations: 0.5 m/s and 40 deg/s, as in Schneider 2019.

    It is in a room; for scenarios without rooms in that of Schneider's motion capture.
    """
    room = WorldOptions(room_size_m=(9.0, 7.0, 3.0), landmarks_per_room=4000)
    world = scenario.world if scenario.world.layout == "rooms" else room
    phases = tuple(
        MotionOptions(
            kind=kind,
            duration_s=15.0,
            turns=0.6,
            wall_distance_m=2.2,
            shake_m=0.05,
            shake_rad=0.15,
            shake_hz=0.7,
        )
        for kind in ("room_scan", "figure_8")
    )
    seeds = dataclasses.replace(scenario.seeds, motion=seed, measurement=seed, appearance=seed)
    sessions = (SessionOptions(phases=phases),)
    evaluated = dataclasses.replace(scenario, seeds=seeds, sessions=sessions, world=world)
    return simulate(evaluated)


def with_noise(
    scenario: Scenario, swaps: float | None, keypoint_sigma_px: float | None, imu_noise: float
) -> Scenario:
    """Return the scenario with other noise; None = unchanged. IMU noise is a multiple."""
    measurement = scenario.measurement
    if swaps is not None:
        measurement = dataclasses.replace(measurement, identity_swap_share=swaps)
    if keypoint_sigma_px is not None:
        measurement = dataclasses.replace(measurement, keypoint_sigma_px=keypoint_sigma_px)
    scaled = {name: imu_noise * getattr(scenario.imu, name) for name in _IMU_NOISE}
    imu = dataclasses.replace(scenario.imu, **scaled)
    return dataclasses.replace(scenario, measurement=measurement, imu=imu)


def problem_of(vi_map: VIMap) -> problem.SegmentProblem:
    """Return the problem of a map with all measurements at full weight."""
    return problem.build_segment_problem(vi_map, OPTIONS, robust=False)


def true_problem(data: SimulatedData) -> problem.SegmentProblem:
    """Return the problem of a session at its true states and calibration."""
    return problem_of(true_map(data.maps[0], data.truth))


def append_line(path: Path, row: Row) -> None:
    """Append a result to a file atomically."""
    before = path.read_text() if path.exists() else ""
    write_text(path, [before, json.dumps(row) + "\n"], overwrite=True)


def lines_of(path: Path) -> list[Row]:
    """Return the results in a file; an empty list if there is no file."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
