"""The explanation of a landmark agrees with the criteria of its quality."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.gate import any_failed
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import criteria, explain_landmark
from tests.vimap.builders import walk_map


@pytest.mark.parametrize(
    "options",
    [
        LandmarkQualityOptions(),
        LandmarkQualityOptions(min_observers=50),
        LandmarkQualityOptions(min_observation_angle_deg=20.0, max_reprojection_error_px=0.5),
        LandmarkQualityOptions(max_distance_from_closest_observer=1.0),
    ],
)
def test_the_explanation_agrees_with_the_verdict(options: LandmarkQualityOptions) -> None:
    vi_map = walk_map()
    rows = np.arange(min(len(vi_map.landmarks), 12))
    gates = criteria(vi_map, rows, options)
    good = ~any_failed(gates)
    for row in rows.tolist():
        report = explain_landmark(vi_map, row, options)
        results = {c.flag: c.result for c in report.criteria}
        for gate in gates:
            if gate.applies[row]:
                assert (results[gate.flag] == "failed") == gate.failed[row]
        error = results["--elq_max_reprojection_error_px"]
        assert (error == "not checked") == (options.max_reprojection_error_px < 0.0)
        assert report.summary.endswith("good.") == good[row]
