"""Registration of pairs of simulated clouds against their true relative poses."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.cloud_registration.options import CloudClosureOptions
from maplab_py.algorithms.cloud_registration.registration import (
    PreparedCloud,
    Registration,
    describe_fit,
    prepare_cloud,
    register_clouds,
)
from maplab_py.algorithms.cloud_registration.workflow import compare_clouds, register_globally
from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from tests.algorithms.cloud_registration.clouds import LONG_CORRIDOR, ROOM, Pair, errors, pairs

OPTIONS = CloudClosureOptions()


def _prepared(pair: Pair) -> tuple[PreparedCloud, PreparedCloud]:
    voxel_m = OPTIONS.voxel_size_m
    return prepare_cloud(pair.target, voxel_m, "a"), prepare_cloud(pair.source, voxel_m, "b")


def _registered(pair: Pair) -> Registration:
    return register_clouds(*_prepared(pair), pair.start, OPTIONS.max_correspondence_m)


def _share_registered(count: int, seeds: int) -> float:
    good = []
    for seed in range(seeds):
        for pair in pairs(ROOM, count // seeds, seed):
            off_m, off_deg = errors(pair.T_T_S, _registered(pair).T_T_S)
            good.append(off_m < 0.02 and off_deg < 0.2)
    return float(np.mean(good))


def test_clouds_of_a_room_are_registered() -> None:
    assert _share_registered(8, 2) == 1.0


@pytest.mark.slow
def test_two_hundred_pairs_of_clouds() -> None:
    assert _share_registered(200, 20) >= 0.98


def test_a_true_pose_fits_and_others_do_not() -> None:
    pair = next(pairs(ROOM, 1, seed=3))
    target, source = _prepared(pair)
    fit = describe_fit(target, source, pair.T_T_S, OPTIONS.max_correspondence_m)
    true = compare_clouds(target, source, pair.T_T_S)
    assert fit.residual_m < OPTIONS.max_residual_m
    assert fit.constraint > OPTIONS.min_constraint
    assert true.overlap > 0.8
    assert true.conflict < 0.01
    turned = se3.compose(pair.T_T_S, se3.make(so3.exp([0.0, 0.0, 0.8]), np.array([2.0, 1.0, 0.0])))
    wrong = compare_clouds(target, source, turned)
    assert wrong.overlap < true.overlap - 0.2 or wrong.conflict > 0.05


def test_a_bare_corridor_does_not_fix_the_position_along_its_axis() -> None:
    """Pairs that pass the gate are right; there are some that are wrong, and the gate refuses them."""
    slid = 0
    for pair in pairs(LONG_CORRIDOR, 14, seed=1):
        fit = _registered(pair)
        off_m, _ = errors(pair.T_T_S, fit.T_T_S)
        slid += off_m > 0.1
        assert off_m < 0.03 or fit.constraint < OPTIONS.min_constraint
    assert slid > 0


def test_the_information_has_the_size_of_the_errors() -> None:
    """Squared errors are some tens of times too large at most: points err together."""
    squared = []
    for pair in pairs(ROOM, 10, seed=5):
        fit = _registered(pair)
        error = se3.local(pair.T_T_S, fit.T_T_S)
        error[:3] = so3.rotate(so3.inverse(pair.T_T_S[:4]), error[:3])
        squared.append(error @ fit.information @ error)
    assert 0.3 < np.median(squared) < 30.0


def test_global_registration_needs_no_initial_pose() -> None:
    count = 0
    for pair in pairs(ROOM, 4, seed=2):
        target, source = _prepared(pair)
        start = register_globally(target, source, OPTIONS.voxel_size_m)
        if start is None:
            continue
        fit = register_clouds(target, source, start, OPTIONS.max_correspondence_m)
        off_m, off_deg = errors(pair.T_T_S, fit.T_T_S)
        count += off_m < 0.05 and off_deg < 0.5
    assert count >= 2


def test_equal_input_gives_equal_poses() -> None:
    pair = next(pairs(ROOM, 1, seed=4))
    np.testing.assert_array_equal(_registered(pair).T_T_S, _registered(pair).T_T_S)


def test_a_cloud_with_few_points_is_refused() -> None:
    with pytest.raises(MapError, match="--lidar_lc_voxel_size_m"):
        prepare_cloud(np.random.default_rng(1).normal(size=(50, 3)), 0.1, "cloud abc")
