"""The commands on edges and vertices, and those that show or move missions, through the session."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.errors import FlagError
from tests.vimap.builders import walk_map


@pytest.fixture
def session() -> Session:
    session = Session(load_registry())
    session.maps.add("walk", walk_map())
    return session


def test_edges_get_uncertainties_and_switch_variables(session: Session) -> None:
    session.run(
        "aeu",
        edge_type="loop_closure",
        translation_std_dev_meters=0.5,
        orientation_std_dev_degrees=1.0,
    )
    assert session.vi_map.loop_closure_edges.covariance[0, 0, 0] == pytest.approx(0.25)
    session.run("asvv", lc_switch_variable_value=0.5)
    session.run("asvuflce", lc_switch_variable_variance=1e-4)
    assert session.vi_map.loop_closure_edges.switch_variable.tolist() == [0.5, 0.5]
    assert session.vi_map.loop_closure_edges.switch_variable_variance.tolist() == [1e-4, 1e-4]


def test_sigmas_must_be_given(session: Session) -> None:
    with pytest.raises(FlagError, match="translation_std_dev_meters"):
        session.run("assign_edge_uncertainties", edge_type="odometry")


def test_vertices_are_disturbed_and_undo_puts_them_back(session: Session) -> None:
    before = session.vi_map
    report = session.run("artificially_disturb_vertices")
    assert report.largest_shift_m > 0.0
    assert np.abs(session.vi_map.vertices.T_M_I - before.vertices.T_M_I).max() > 0.0
    session.run("undo")
    assert session.vi_map is before


def test_missions_are_laid_apart(session: Session) -> None:
    assert "1 mission " in session.run("spatially_distribute_missions").text
    np.testing.assert_array_equal(session.vi_map.T_G_M[0, 4:], [20.0, 0.0, 0.0])
    session.run("set_all_mission_baseframes_to_known")
    assert "nothing" in session.run("spatially_distribute_missions").text


def test_statistics_and_size_change_nothing(session: Session) -> None:
    before = session.vi_map
    assert any("track" in line.quantity for line in session.run("statistics").quantities)
    size = session.run("map_size")
    assert {kind.kind for kind in size.kinds} >= {"descriptors", "IMU samples", "landmarks"}
    assert session.vi_map is before
