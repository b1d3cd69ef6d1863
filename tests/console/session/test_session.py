"""Sessions: commands as transactions on several maps."""

from __future__ import annotations

import pytest

from maplab_py.errors import EstimationError, MaplabError, UserError
from maplab_py.report import Message
from maplab_py.vimap import VIMap
from tests.console.sample_plugin import make_session, map_of


def test_commit_makes_the_new_value_and_undo_has_the_old() -> None:
    session = make_session()
    first = map_of(1)
    session.maps.add("a", first, is_saved=True)
    assert session.maps.selected.is_saved
    assert session.run("add_mission") == Message("2 missions")
    assert len(session.vi_map.missions) == 2
    assert not session.maps.selected.is_saved
    session.maps.update(session.maps.selected.undone())
    assert session.vi_map is first
    assert session.maps.selected.is_saved
    session.maps.update(session.maps.selected.redone())
    assert len(session.vi_map.missions) == 2


@pytest.mark.parametrize(
    ("how", "error"),
    [("user", UserError), ("estimation", EstimationError), ("program", ZeroDivisionError)],
)
def test_a_failed_command_leaves_every_map_as_it_was(how: str, error: type[Exception]) -> None:
    session = make_session()
    session.maps.add("a", map_of(1))
    before = session.maps.state
    with pytest.raises(error):
        session.run("fail_after_commit", how=how)
    assert session.maps.state is before


def test_a_command_that_needs_a_map_is_refused_without_one() -> None:
    session = make_session()
    with pytest.raises(UserError, match="no map is selected; load one"):
        session.run("add_mission")
    session.maps.add("a", VIMap())
    session.maps.add("b", VIMap())
    session.maps.remove("b")
    assert session.maps.selected_key == "a"


def test_keys_are_checked_and_proposed() -> None:
    maps = make_session().maps
    maps.add("euroc", VIMap())
    with pytest.raises(UserError, match="is in use"):
        maps.add("euroc", VIMap())
    with pytest.raises(UserError, match="cannot be a map key"):
        maps.add("a b", VIMap())
    with pytest.raises(UserError, match="did you mean euroc"):
        maps.select("eurok")
    assert maps.keys == ["euroc"]


def test_rename_keeps_place_and_selection() -> None:
    maps = make_session().maps
    for key in "abc":
        maps.add(key, VIMap(), select=False)
    maps.rename("a", "z")
    assert maps.keys == ["z", "b", "c"]
    assert maps.selected_key == "z"


def test_destructive_commands_are_refused_where_nobody_answers() -> None:
    session = make_session()
    with pytest.raises(UserError, match="give --yes"):
        session.run("destroy")
    assert session.run("destroy", yes=True) == Message("destroyed")


def test_mission_rows_take_prefixes() -> None:
    from maplab_py.console.session.context import CommandContext
    from maplab_py.progress import SILENT

    session = make_session()
    session.maps.add("a", map_of(3))
    context = CommandContext(session, SILENT, session.terminal)
    assert context.mission_rows() is None
    assert context.mission_rows("2") == [1]
    rows = context.mission_rows("", "3, 1")
    assert rows is not None
    assert rows.tolist() == [0, 2]
    with pytest.raises(UserError, match="no mission begins with 'f'"):
        context.mission_rows("f")
    with pytest.raises(UserError):
        context.mission_row("")


def test_timings_are_kept_even_of_failures() -> None:
    session = make_session()
    session.run("echo", "a")
    with pytest.raises(MaplabError):
        session.run("destroy")
    assert [timing.command for timing in session.timings] == ["echo", "destroy"]


def test_words_reach_a_variadic_command() -> None:
    session = make_session()
    assert session.run("echo", "a", "b c") == Message("a b c")
    assert session.execute(session.parse(["echo", "x", "y"])) == Message("x y")
