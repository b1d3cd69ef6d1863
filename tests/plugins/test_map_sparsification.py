"""The commands on landmarks, keyframing and sparsification, through the session."""

from pathlib import Path

import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.vimap import consistency
from tests.vimap.builders import walk_map


@pytest.fixture
def session() -> Session:
    session = Session()
    session.maps.add("walk", walk_map())
    return session


def test_a_dry_run_says_what_keyframing_then_does(session: Session) -> None:
    flags = {"kf_every_nth_vertex": 3, "kf_min_shared_landmarks_obs": 0}
    before = session.vi_map
    planned = session.run("kfh", dry_run=True, **flags)
    assert session.vi_map is before
    done = session.run("kfh", **flags)
    assert len(session.vi_map.vertices) == done.vertices_after == planned.vertices_after < 12
    assert consistency.check_consistency(session.vi_map).errors == ()


def test_sparsification_keeps_as_many_as_it_is_told(session: Session, tmp_path: Path) -> None:
    table = tmp_path / "coverage.csv"
    before = session.vi_map
    planned = session.run("lsparsify", num_landmarks_to_keep=15, dry_run=True, coverage_csv=table)
    assert session.vi_map is before
    assert not table.exists()
    done = session.run("landmark_sparsify", num_landmarks_to_keep=15, coverage_csv=table)
    assert len(session.vi_map.landmarks) == 15 == planned.landmarks_after == done.landmarks_after
    assert consistency.check_consistency(session.vi_map).errors == ()
    header, *lines = table.read_text().splitlines()
    assert header == "vertex,before,after,wanted"
    assert len(lines) == done.keyframes


def test_sparsification_asks_for_a_number(session: Session, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="needs --num_landmarks_to_keep="):
        session.run("landmark_sparsify")
    with pytest.raises(UserError, match="--num_landmarks_to_keep=0: wants a number above 0"):
        session.run("landmark_sparsify", num_landmarks_to_keep=0)
    table = tmp_path / "coverage.csv"
    table.write_text("mine")
    with pytest.raises(UserError, match="overwrite"):
        session.run("landmark_sparsify", num_landmarks_to_keep=15, coverage_csv=table)
    assert table.read_text() == "mine"


def test_an_unknown_mission_is_refused(session: Session) -> None:
    before = session.vi_map
    for command in ("rtl", "itl", "elq", "rlq", "rbl", "rio"):
        with pytest.raises(UserError, match="no mission begins"):
            session.run(command, map_mission="xyz")
    assert session.vi_map is before
