"""The landmark commands, through the session."""

import numpy as np
import pytest

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.vimap.edits import remove_landmarks
from tests.vimap.builders import walk_map


@pytest.fixture
def session() -> Session:
    session = Session(load_registry())
    session.maps.add("walk", walk_map())
    return session


def test_quality_commands_commit_what_they_report(session: Session) -> None:
    judged = session.run("elq", elq_min_observers=10)
    assert np.count_nonzero(session.vi_map.landmarks.quality == 2) == judged.good
    left = session.run("rbl")
    assert left.landmarks_removed == judged.bad > 0
    assert len(session.vi_map.landmarks) == judged.good
    assert session.run("rlq").unknown == judged.good


def test_triangulation_and_tracks(session: Session) -> None:
    report = session.run("rtl")
    assert report.triangulated + report.too_few_observations == report.landmarks
    m = session.vi_map
    session.maps.add("bare", remove_landmarks(m, np.ones(len(m.landmarks), dtype=bool)))
    session.run("select", map_key="bare")
    added = session.run("itl")
    assert added.landmarks_added == len(session.vi_map.landmarks) == report.triangulated
    assert session.run("rio").observations == added.observations_added


def test_an_unknown_mission_is_refused(session: Session) -> None:
    before = session.vi_map
    for command in ("rtl", "itl", "elq", "rlq", "rbl", "rio"):
        with pytest.raises(UserError, match="no mission begins"):
            session.run(command, map_mission="xyz")
    assert session.vi_map is before
