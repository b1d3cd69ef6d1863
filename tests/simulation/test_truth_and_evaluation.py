"""The truth file, and errors measured against it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import se3, yaw
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.truth import Truth
from maplab_py.vimap import VIMap
from maplab_py.vimap.merge import merge_maps
from tests.simulation.small import SMALL, simulated


def _true_map() -> VIMap:
    """Return the merged map with true poses, in a frame of its own."""
    merged, _ = merge_maps(*simulated().maps)
    truth = simulated().truth
    T_own_G = yaw.to_pose([1.0, -2.0, 0.5, 0.8])
    T_M_I = se3.compose(se3.inverse(truth.T_G_M)[truth.vertex_mission], truth.T_G_I)
    return merged.replace(
        vertices=merged.vertices.replace(T_M_I=T_M_I),
        baseframes=merged.baseframes.replace(T_G_M=se3.compose(T_own_G, truth.T_G_M)),
    )


def test_truth_survives_its_file(tmp_path: Path) -> None:
    truth = simulated().truth
    truth.save(tmp_path / "truth.npz")
    back = Truth.load(tmp_path / "truth.npz")
    for field in dataclasses.fields(truth):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(truth, field.name))


def test_files_that_are_no_truth(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such truth file"):
        Truth.load(tmp_path / "none.npz")
    (tmp_path / "bad.npz").write_bytes(b"something else")
    with pytest.raises(UserError, match=r"bad\.npz is not a truth file"):
        Truth.load(tmp_path / "bad.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(UserError, match=r"other\.npz is not a truth file"):
        Truth.load(tmp_path / "other.npz")


def test_a_true_map_has_no_error_in_any_frame() -> None:
    errors = evaluate_map(_true_map(), simulated().truth)
    assert errors.ate_m < 1e-9
    assert errors.ate_each_m < 1e-9
    assert errors.scale == pytest.approx(1.0)
    for mission in errors.missions:
        assert mission.offset_m < 1e-9
        assert mission.yaw_deg < 1e-6


def test_a_misplaced_mission_shows_in_offset_and_yaw_alone() -> None:
    vi_map = _true_map()
    T_G_M = np.array(vi_map.baseframes.T_G_M)
    row = vi_map.missions.baseframe[1]
    middle = vi_map.T_G_I[vi_map.vertices.mission == 1, 4:].mean(axis=0)
    about = yaw.to_pose(np.append(middle, 0.0))
    turn = se3.compose(about, se3.compose(yaw.to_pose([0, 0, 0, 0.05]), se3.inverse(about)))
    T_G_M[row] = se3.compose(turn, T_G_M[row])
    moved = vi_map.replace(baseframes=vi_map.baseframes.replace(T_G_M=T_G_M))
    errors = evaluate_map(moved, simulated().truth)
    assert errors.ate_each_m < 1e-9
    assert errors.ate_m > 0.005
    total = sum(mission.yaw_deg for mission in errors.missions)
    assert total == pytest.approx(np.rad2deg(0.05), rel=1e-6)


def test_drift_is_seen_before_anything_is_done() -> None:
    merged, _ = merge_maps(*simulated().maps)
    errors = evaluate_map(merged, simulated().truth)
    assert errors.ate_m > errors.ate_each_m > 0.003
    assert [mission.vertices for mission in errors.missions] == [31, 21]


def test_truth_of_another_data_set_is_refused() -> None:
    from maplab_py.simulation.simulate import simulate

    other = simulate(dataclasses.replace(SMALL.with_seed(77), sessions=SMALL.sessions[1:]))
    with pytest.raises(UserError, match="another data set"):
        evaluate_map(simulated().maps[0], other.truth)
