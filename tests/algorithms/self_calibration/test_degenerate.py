"""Motions that do not excite everything are refused, and what they lack is named."""

from __future__ import annotations

import dataclasses

import pytest

from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.errors import EstimationError
from maplab_py.simulation.scenario import MotionOptions, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate

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
