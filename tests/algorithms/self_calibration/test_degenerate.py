"""Motions that do not excite everything are refused, and what they lack is named."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.estimation.problem import build_segment_problem
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.segments.selection import collect
from maplab_py.errors import EstimationError
from maplab_py.simulation.scenario import MotionOptions, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import true_map

STILL = {"shake_m": 0.0, "shake_rad": 0.0}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "lacking"),
    [
        (
            MotionOptions(kind="straight", duration_s=10.0, wall_distance_m=2.0, **STILL),
            "gyroscope",
        ),
        (MotionOptions(kind="stationary", duration_s=10.0, **STILL), "gyroscope"),
        (MotionOptions(kind="rotation", duration_s=14.0, turns=1.2, **STILL), "camera position"),
        (MotionOptions(kind="rotation", duration_s=14.0, turns=1.2), "camera position"),
    ],
)
def test_degenerate_motion_is_refused(motion: MotionOptions, lacking: str) -> None:
    scenario = dataclasses.replace(
        load_scenario("ar_room"), sessions=(SessionOptions(phases=(motion,)),)
    )
    with pytest.raises(EstimationError, match="not excited") as refused:
        calibrate(simulate(scenario).maps[0], SelfCalibrationOptions())
    assert lacking in str(refused.value)
    # the user can act on it
    assert "record motion" in str(refused.value)


@pytest.mark.slow
def test_turning_among_other_motion_does_not_spoil_the_calibration() -> None:
    """A session that put the camera 9 sigmas off: 12 s of turning and shaking, badly tracked."""
    scenario = load_scenario("ar_room")
    seeds = dataclasses.replace(scenario.seeds, motion=106, measurement=206, appearance=306)
    data = simulate(dataclasses.replace(scenario, seeds=seeds, sessions=(scenario.sessions[1],)))
    options = SelfCalibrationOptions()
    database, _ = collect(data.maps[0], options)
    result, _ = calibrate(database.vi_map, options)
    truth = build_segment_problem(
        true_map(data.maps[0], data.truth), options, robust=False
    ).states.blocks
    off = result.parameters.difference(result.blocks, truth)
    assert np.abs(off / np.sqrt(np.diag(result.uncertainty.formal))).max() <= 3.5
