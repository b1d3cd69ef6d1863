"""What is not believed, and how far results on parts of the data spread."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.limits import checked
from maplab_py.algorithms.self_calibration.plausibility import calibrate_plausibly
from maplab_py.errors import UserError
from tests.algorithms.self_calibration.scenes import OPTIONS, device, scene_map, uncalibrated

CAMERA = dataclasses.replace(
    OPTIONS,
    states="intrinsics,extrinsics_rotation,extrinsics_translation",
    keep_unobservable_at_prior=True,
)


def test_a_camera_that_moves_too_far_is_kept_where_it_was() -> None:
    start = uncalibrated(scene_map(noise=1.0))
    free, _, believed = calibrate_plausibly(start, CAMERA, batch=True, max_camera_shift_m=1.0)
    held, _, report = calibrate_plausibly(start, CAMERA, batch=True, max_camera_shift_m=1e-5)
    before = device(start)[1].T_B_C[:, 4:]
    kept = [one for one in report.parameters if "position" in one.parameter]
    assert len(report.parameters) == len(believed.parameters)
    assert all(one.verdict.startswith("kept: the data would move") for one in kept)
    rig_id = device(start)[1].id
    assert np.abs(held.camera_rig(rig_id).T_B_C[:, 4:] - before).max() <= 1e-12
    assert np.abs(free.camera_rig(rig_id).T_B_C[:, 4:] - before).max() > 1e-5


def test_segments_likewise() -> None:
    start = uncalibrated(scene_map(vertices=61, noise=1.0))
    held, database, report = calibrate_plausibly(start, CAMERA, max_camera_shift_m=1e-5)
    assert database is not None
    rig = device(start)[1]
    assert np.abs(held.camera_rig(rig.id).T_B_C[:, 4:] - rig.T_B_C[:, 4:]).max() <= 1e-12
    assert any(one.verdict.startswith("kept") for one in report.parameters)


def test_the_spread_of_parts_widens_deviations_and_never_narrows_them() -> None:
    start = uncalibrated(scene_map(vertices=61, noise=1.0))
    _, _, formal = calibrate_plausibly(start, CAMERA, batch=True)
    _, _, widened = calibrate_plausibly(start, CAMERA, batch=True, parts=3)
    ratio = [b.sigma / a.sigma for a, b in zip(formal.parameters, widened.parameters, strict=True)]
    assert min(ratio) >= 1.0 - 1e-9
    # the simulated device is what the model says: results scatter as announced
    assert float(np.median(ratio)) <= 2.0
    with pytest.raises(UserError, match="two parts"):
        calibrate_plausibly(start, CAMERA, batch=True, parts=1)


@pytest.mark.parametrize(
    ("field", "value"),
    [("segments_per_group", 0), ("segment_keyframes", 1), ("prior_position_m", 0.0)],
)
def test_flags_without_meaning_are_named(field: str, value: Any) -> None:
    with pytest.raises(UserError, match=f"--sc_{field}"):
        checked(dataclasses.replace(OPTIONS, **{field: value}))
