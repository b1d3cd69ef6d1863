"""What compare_maps counts and measures."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.evaluation.map_comparison import compare_maps
from maplab_py.geometry import se3, so3
from maplab_py.vimap import VIMap
from maplab_py.vimap.tables import LandmarkQuality
from tests.interop.small_map import make_map


def test_a_map_equals_itself() -> None:
    report = compare_maps(make_map(), make_map())
    assert report.is_identical
    assert all(row.only_in_first == row.only_in_second == 0 for row in report.rows)
    assert report.position_m.largest == report.keypoint_px.largest == 0.0
    assert (report.descriptors_differing, report.sensors_differing) == (0, ())


def test_every_difference_is_measured() -> None:
    first = make_map()
    T = first.vertices.T_M_I.copy()
    T[3] = se3.compose(T[3], se3.make(so3.exp([0.0, 0.0, np.deg2rad(2.0)]), [0.3, 0.0, 0.0]))
    uv = first.keypoints.uv_px.copy()
    uv[5] += [3.0, 4.0]
    landmark = first.keypoints.landmark.copy()
    landmark[0] = -1
    descriptor = first.keypoints.descriptor.copy()
    descriptor[7, 0] ^= 1
    quality = first.landmarks.quality.copy()
    quality[0] = LandmarkQuality.BAD
    second = first.replace(
        vertices=first.vertices.replace(T_M_I=T),
        keypoints=first.keypoints.replace(uv_px=uv, landmark=landmark, descriptor=descriptor),
        landmarks=first.landmarks.replace(quality=quality),
    )
    report = compare_maps(first, second)
    assert not report.is_identical
    assert report.position_m.largest == pytest.approx(0.3)
    assert report.rotation_deg.largest == pytest.approx(2.0)
    assert report.keypoint_px.largest == pytest.approx(5.0)
    observations = next(row for row in report.rows if row.what == "observations")
    assert (observations.only_in_first, observations.only_in_second) == (1, 0)
    assert (report.descriptors_differing, report.landmarks_of_other_quality) == (1, 1)


def test_maps_with_nothing_in_common() -> None:
    report = compare_maps(make_map(), VIMap())
    rows = {row.what: row for row in report.rows}
    assert (rows["vertices"].in_both, rows["vertices"].only_in_first) == (0, 12)
    assert report.position_m.compared == 0
