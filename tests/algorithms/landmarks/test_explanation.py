"""The explanation of a landmark agrees with the criteria of its quality."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import explain_landmark, judge
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
    verdict = judge(vi_map, rows, options)
    for row in rows.tolist():
        report = explain_landmark(vi_map, row, options)
        results = {c.flag: c.result for c in report.criteria}
        assert (results["--elq_min_observers"] == "failed") == verdict.too_few_observers[row]
        angle = results["--elq_min_observation_angle_deg"]
        assert (angle == "failed") == verdict.too_small_angle[row]
        far = results["--elq_max_distance_from_closest_observer"]
        assert (far == "failed") == verdict.too_far[row]
        error = results["--elq_max_reprojection_error_px"]
        assert (error == "failed") == verdict.too_large_error[row]
        assert (error == "not checked") == (options.max_reprojection_error_px < 0.0)
        assert report.summary.endswith("good.") == verdict.is_good[row]
