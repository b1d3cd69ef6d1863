"""Draw where a session's information is: python docs/scripts/draw_segment_information.py.

Writes docs/images/segment_information.svg: a session of the scenario ar_room, coloured by what each
segment says about the IMU (thesis, figure 7.1).
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np

from maplab_py.algorithms.self_calibration.drawing import draw
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.workflow import segment_information
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import VIMap

IMAGE = Path(__file__).resolve().parents[1] / "images" / "segment_information.svg"


def picture(vi_map: VIMap) -> str:
    """Return the SVG."""
    report, segments = segment_information(vi_map, SelfCalibrationOptions())
    values = np.array([one.imu for one in report.segments])
    return draw(vi_map, segments, values, "information about the IMU, scenario ar_room")


def main() -> int:
    """Simulate a session and draw it."""
    scenario = load_scenario("ar_room")
    data = simulate(dataclasses.replace(scenario, sessions=scenario.sessions[:1]))
    IMAGE.write_text(picture(data.maps[0]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
