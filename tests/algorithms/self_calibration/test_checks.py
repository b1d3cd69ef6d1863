"""What is not believed, and how far results on parts of the data spread."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration import checks
from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.checks import calibrate_with_checks
from maplab_py.errors import UserError
from tests.algorithms.self_calibration.scenes import OPTIONS, device, scene_map, uncalibrated

CAMERA = dataclasses.replace(
    OPTIONS,
    states="intrinsics,extrinsics_rotation,extrinsics_translation",
    keep_unobservable_at_prior=True,
)


def test_a_camera_that_moves_too_far_is_kept_where_it_was() -> None:
    start = uncalibrated(scene_map(noise=1.0))
    free, _, believed = calibrate_with_checks(start, CAMERA, batch=True, max_camera_shift_m=1.0)
    held, _, report = calibrate_with_checks(start, CAMERA, batch=True, max_camera_shift_m=1e-5)
    before = device(start)[1].T_B_C[:, 4:]
    kept = [one for one in report.parameters if "position" in one.parameter]
    assert len(report.parameters) == len(believed.parameters)
    assert all(one.verdict.startswith("kept: the data would move") for one in kept)
    rig_id = device(start)[1].id
    assert np.abs(held.camera_rig(rig_id).T_B_C[:, 4:] - before).max() <= 1e-12
    assert np.abs(free.camera_rig(rig_id).T_B_C[:, 4:] - before).max() > 1e-5


def test_segments_likewise() -> None:
    start = uncalibrated(scene_map(vertices=61, noise=1.0))
    held, database, report = calibrate_with_checks(start, CAMERA, max_camera_shift_m=1e-5)
    assert database is not None
    rig = device(start)[1]
    assert np.abs(held.camera_rig(rig.id).T_B_C[:, 4:] - rig.T_B_C[:, 4:]).max() <= 1e-12
    assert any(one.verdict.startswith("kept") for one in report.parameters)


def test_the_spread_of_parts_widens_deviations_and_never_narrows_them() -> None:
    start = uncalibrated(scene_map(vertices=61, noise=1.0))
    _, _, formal = calibrate_with_checks(start, CAMERA, batch=True)
    _, _, widened = calibrate_with_checks(start, CAMERA, batch=True, parts=3)
    ratio = [b.sigma / a.sigma for a, b in zip(formal.parameters, widened.parameters, strict=True)]
    assert min(ratio) >= 1.0 - 1e-9
    # the simulated device is what the model says: results scatter as announced
    assert float(np.median(ratio)) <= 2.0
    with pytest.raises(UserError, match="two parts"):
        calibrate_with_checks(start, CAMERA, batch=True, parts=1)


def test_the_spread_is_the_standard_error_of_the_mean_of_parts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start = uncalibrated(scene_map(vertices=41, noise=1.0))
    changes, deviations = [], []

    def recorded(*arguments: Any, **keywords: Any) -> Any:
        result, report = calibrate(*arguments, **keywords)
        changes.append(result.change)
        return result, report

    def noted(report: Any, result: Any, *arguments: Any) -> Any:
        deviations.append(result.uncertainty.model_sigma)
        return with_spread(report, result, *arguments)

    with_spread = checks._with_spread
    monkeypatch.setattr(checks, "calibrate", recorded)
    monkeypatch.setattr(checks, "_with_spread", noted)
    _, _, report = calibrate_with_checks(start, CAMERA, batch=True, parts=4)
    assert len(changes) == 5  # of all data, then of the parts
    expected = np.maximum(np.std(changes[1:], axis=0, ddof=1) / 2.0, deviations[0])
    # one of them at least must be larger than what the noise explains, or nothing is tested
    assert np.any(expected > deviations[0])
    np.testing.assert_allclose([one.sigma for one in report.parameters], expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("field", "value"),
    [("segments_per_group", 0), ("segment_keyframes", 1), ("prior_position_m", 0.0)],
)
def test_flags_without_meaning_are_named(field: str, value: Any) -> None:
    with pytest.raises(UserError, match=f"--sc_{field}"):
        dataclasses.replace(OPTIONS, **{field: value})
