"""The keyframing command, through the session."""

import pytest

from maplab_py.console.registry import load_registry
from maplab_py.console.session import Session
from maplab_py.errors import FlagError
from maplab_py.vimap.consistency import check_consistency
from tests.vimap.builders import walk_map


@pytest.fixture
def session() -> Session:
    session = Session(load_registry())
    session.maps.add("walk", walk_map())
    return session


def test_a_dry_run_says_what_keyframing_then_does(session: Session) -> None:
    flags = {"kf_every_nth_vertex": 3, "kf_min_shared_landmarks_obs": 0}
    before = session.vi_map
    planned = session.run("kfh", dry_run=True, **flags)
    assert session.vi_map is before
    done = session.run("kfh", **flags)
    assert len(session.vi_map.vertices) == done.vertices_after == planned.vertices_after < 12
    assert check_consistency(session.vi_map).errors == ()


def test_a_bad_threshold_is_refused(session: Session) -> None:
    with pytest.raises(FlagError, match="kf_every_nth_vertex"):
        session.run("kfh", kf_every_nth_vertex=0)
