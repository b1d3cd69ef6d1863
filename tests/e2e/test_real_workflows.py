"""The multi-session workflow on recorded maps, held to the accuracy that the project promises.

Truth for EuRoC V1_01: O is the file as shipped (it errs by about 0.037 m itself), C the corrected
one. Errors are APE RMSE after SE(3) alignment.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.geometry import se3, so3
from maplab_py.vimap import VIMap
from tests.support.data import shared_data

pytestmark = pytest.mark.slow

O_TRUTH, C_TRUTH = "ground_truth/V1_01_easy.csv", "euroc_imu/V101.gt.csv"
SUBMAPS = "maplab_maps/euroc_v1_01"


@pytest.fixture
def session() -> Session:
    return Session(load_registry())


def ape_m(session: Session, truth: str, alignment: str = "se3") -> Any:
    path = shared_data(truth)
    return session.run("evaluate_trajectory", ground_truth=path, alignment=alignment)


def vi_map(session: Session) -> VIMap:
    return session.maps.selected.vi_map


def test_euroc_submaps_as_one_mission(session: Session) -> None:
    session.run("load_merge_all_submaps", maps_folder=shared_data(SUBMAPS))
    assert ape_m(session, O_TRUTH).ape_m.rmse == pytest.approx(0.118, abs=1e-3)
    assert ape_m(session, C_TRUTH).ape_m.rmse == pytest.approx(0.115, abs=1e-3)
    session.run("elq")
    session.run("optvi")
    assert ape_m(session, O_TRUTH).ape_m.rmse <= 0.044
    assert ape_m(session, C_TRUTH).ape_m.rmse <= 0.037
    session.run("lc")
    session.run("optvi")
    assert ape_m(session, O_TRUTH).ape_m.rmse <= 0.038
    corrected = ape_m(session, C_TRUTH)
    assert corrected.ape_m.rmse <= 0.020
    assert corrected.ape_sim3_m.rmse <= 0.011
    assert abs(corrected.scale - 1.0) <= 0.02


def scrambled(before: VIMap, seed: int) -> VIMap:
    """Turn each base frame but the first by any heading and shift it by up to 10 m."""
    rng = np.random.default_rng(seed)
    frames = before.baseframes
    count = len(frames)
    yaw = np.zeros((count, 3))
    yaw[:, 2] = rng.uniform(-np.pi, np.pi, count)
    moved = se3.compose(
        se3.make(so3.exp(yaw), rng.uniform(-10.0, 10.0, (count, 3)) / np.sqrt(3.0)), frames.T_G_M
    )
    moved[0] = frames.T_G_M[0]
    return before.replace(
        baseframes=frames.replace(T_G_M=moved, is_known=np.zeros(count, dtype=np.bool_))
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_euroc_submaps_as_eight_scrambled_missions(session: Session, seed: int) -> None:
    session.run("load_merge_all_maps", maps_folder=shared_data(SUBMAPS), assign_new_ids=True)
    entry = session.maps.selected
    session.maps.update(entry.with_value(scrambled(entry.vi_map, seed), "scramble"))
    for command in ("elq", "optvi", "set_mission_baseframe_to_known", "anchor_all_missions"):
        session.run(command)
    assert vi_map(session).baseframes.is_known.all()
    session.run("relax")
    assert ape_m(session, O_TRUTH).ape_m.rmse <= 0.08
    session.run("lc")
    session.run("optvi")
    assert ape_m(session, O_TRUTH).ape_m.rmse <= 0.038
    assert ape_m(session, C_TRUTH).ape_m.rmse <= 0.019


def test_tango_walk_is_optimised_and_its_loop_closed(session: Session) -> None:
    session.run("load", map_folder=shared_data("maplab_maps/tango_handheld"))
    report = session.run("optvi")
    assert report.cost_after <= 0.92 * report.cost_before
    kept = report.observations - report.observations_not_used - report.observations_rejected
    assert kept >= 0.93 * report.observations
    assert report.mean_reprojection_after_px <= 0.80
    session.run("set_mission_baseframe_to_known")
    session.run("relax")
    session.run("lc")
    closed = session.run("optvi")
    kept_closed = closed.observations - closed.observations_not_used - closed.observations_rejected
    assert kept_closed >= 0.99 * kept
    again = session.run("lc", lc_insert_lc_edge_instead_of_merging=True)
    assert again.median_correction_m <= 0.006


def test_same_input_same_bytes(tmp_path: Path) -> None:
    saved = []
    for name in ("a", "b"):
        session = Session(load_registry())
        session.run("load_merge_all_submaps", maps_folder=shared_data(SUBMAPS))
        session.run("optvi", ba_num_iterations=5)
        session.run("lc")
        session.run("save", map_folder=tmp_path / name)
        files = sorted((tmp_path / name / "vi_map").iterdir())
        saved.append({path.name: path.read_bytes() for path in files})
    assert saved[0] == saved[1]


def test_threads_do_not_change_the_result() -> None:
    import numba

    results = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        session = Session(load_registry())
        session.run("load_merge_all_submaps", maps_folder=shared_data(SUBMAPS))
        session.run("optvi", ba_num_iterations=8)
        results.append(vi_map(session))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    for field in dataclasses.fields(results[0].vertices):
        if field.name in ("T_M_I", "v_M", "gyro_bias", "accel_bias"):
            one, two = (getattr(result.vertices, field.name) for result in results)
            np.testing.assert_allclose(one, two, atol=1e-9)


def test_threads_do_not_change_loop_closures(tmp_path: Path) -> None:
    import numba

    saved = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        session = Session(load_registry())
        session.run("load_merge_all_submaps", maps_folder=shared_data(SUBMAPS))
        assert session.run("lc").landmarks_merged > 100
        session.run("save", map_folder=tmp_path / str(threads))
        files = sorted((tmp_path / str(threads) / "vi_map").iterdir())
        saved.append({path.name: path.read_bytes() for path in files})
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert saved[0] == saved[1]
