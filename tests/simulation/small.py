"""A scenario that is simulated in a fraction of a second."""

import dataclasses
import importlib.util
from functools import cache
from types import ModuleType

from maplab_py.simulation.scenario import MeasurementOptions, Scenario, SessionOptions, WorldOptions
from maplab_py.simulation.simulate import SimulatedData, simulate
from tests.support import data, noiseless

SMALL = Scenario(
    name="small",
    world=WorldOptions(landmarks_per_room=1200),
    measurement=MeasurementOptions(frame_rate_hz=5.0, max_keypoints=150),
    sessions=(
        SessionOptions(duration_s=6.0, turns=0.3),
        SessionOptions(kind="figure_8", duration_s=4.0, turns=0.3, start_turn=0.1, reverse=True),
    ),
)
PERFECT = dataclasses.replace(noiseless.without_noise(SMALL), sessions=SMALL.sessions[:1])


@cache
def simulated(scenario: Scenario = SMALL) -> SimulatedData:
    return simulate(scenario)


def docs_script(name: str) -> ModuleType:
    """Import a script of the documentation."""
    path = data.REPOSITORY / "docs" / "scripts" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
