"""A scenario that is simulated in a fraction of a second."""

from __future__ import annotations

import dataclasses
from functools import cache

from maplab_py.simulation.scenario import MeasurementOptions, MotionOptions, Scenario, WorldOptions
from maplab_py.simulation.simulate import SimulatedData, simulate

SMALL = Scenario(
    name="small",
    world=WorldOptions(landmarks_per_room=1200),
    measurement=MeasurementOptions(frame_rate_hz=5.0, max_keypoints=150),
    sessions=(
        MotionOptions(duration_s=6.0, turns=0.3),
        MotionOptions(kind="figure_8", duration_s=4.0, turns=0.3, start_turn=0.1, reverse=True),
    ),
)
PERFECT = dataclasses.replace(SMALL.without_noise(), sessions=SMALL.sessions[:1])


@cache
def simulated(scenario: Scenario = SMALL) -> SimulatedData:
    return simulate(scenario)
