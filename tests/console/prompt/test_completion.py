"""What the console proposes, and how it colours a line."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.prompt.completion import complete, match_rank
from maplab_py.console.prompt.loop import coloured_parts
from maplab_py.console.session.session import Session
from maplab_py.errors import FlagError
from maplab_py.storage.mission_names import named
from maplab_py.storage.native import save_map
from maplab_py.vimap import VIMap
from tests.console.sample_plugin import make_registry, make_session, map_of

REGISTRY = make_registry()


@pytest.fixture
def session() -> Session:
    session = make_session()
    session.maps.add("v1_01", map_of(3))
    session.maps.add("v1_02", VIMap(), select=False)
    return session


def texts(line: str, session: Session) -> list[str]:
    return [candidate.text for candidate in complete(line, session)]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("sol", ["solve"]),
        ("ovl", []),
        ("slve", ["solve"]),
        ("echo a; sol", ["solve"]),
        ("nosuch --", []),
        ("solve --ba_l", ["--ba_loss="]),
        ("solve --ba-l", ["--ba_loss="]),
        ("solve --loss", ["--ba_loss="]),
        ("solve -fix", ["--fix_gravity"]),
        ("solve --ba_loss=", ["--ba_loss=cauchy", "--ba_loss=huber", "--ba_loss=none"]),
        ("solve --ba_loss=c", ["--ba_loss=cauchy"]),
        ("solve --ba_loss c", ["cauchy"]),
        ("solve --fix_gravity=f", ["--fix_gravity=false"]),
        ("solve --colour=d", ["--colour=deep_blue"]),
        ("set --ba_l", ["--ba_loss="]),
        ("set --ba_loss=h", ["--ba_loss=huber"]),
        ("help sol", ["solve"]),
    ],
)
def test_candidates(line: str, expected: list[str], session: Session) -> None:
    assert texts(line, session) == expected


def ranked(typed: str, *names: str) -> list[str]:
    return sorted(names, key=lambda name: (match_rank(typed, name) or (9, 0), len(name)))


def test_names_are_ranked_by_how_well_they_fit() -> None:
    assert (
        ranked("ovi", "rovioli", "optimize_visual_inertial_x", "optvi", "close_via")[0] == "optvi"
    )
    assert ranked("map", "list_maps", "remap", "map", "map_stats") == [
        "map",
        "map_stats",
        "list_maps",
        "remap",
    ]
    assert match_rank("ovx", "optvi") is None


@given(st.text("abc", min_size=1, max_size=4), st.text("abc_", min_size=1, max_size=9))
def test_a_name_fits_if_it_has_the_letters_in_order(typed: str, name: str) -> None:
    letters = iter(name)
    assert (match_rank(typed, name) is not None) == all(letter in letters for letter in typed)


def test_ovi_finds_optvi_first_among_all_commands() -> None:
    assert texts("ovi", Session(load_registry()))[0] == "optvi"


def test_what_is_used_comes_before_what_fits_as_well(session: Session) -> None:
    session.aliases.update({"tally": "echo a", "tarry": "echo b"})
    assert texts("ty", session)[:2] == ["tally", "tarry"]
    session.uses["tarry"] += 1
    assert texts("ty", session)[:2] == ["tarry", "tally"]


def test_values_that_the_session_knows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session(load_registry())
    session.maps.add("office", named(map_of(2), ["monday", "tuesday"]))
    session.run("snapshot", "before_relax")
    session.aliases["tidy"] = "elq"
    assert texts("restore ", session) == ["before_relax"]
    assert texts("evaluate_trajectory --baseline=b", session) == ["--baseline=before_relax"]
    assert texts("unalias t", session) == ["tidy"]
    assert texts("tid", session)[0] == "tidy"
    assert texts("sbk --map_mission=tu", session) == ["--map_mission=tuesday"]
    assert texts("sbk --map_mission=1", session) == ["--map_mission=monday"]
    (mission,) = complete("sbk mond", session)
    assert mission.help.startswith("1000") or "m from " in mission.help
    save_map(map_of(1), tmp_path / "zoo")
    (tmp_path / "attic").mkdir()
    monkeypatch.chdir(tmp_path)
    assert texts("load ", session) == ["zoo/", "attic/"]
    assert texts("!ls z", session) == ["zoo/"]
    assert texts("map_stats | tee a", session) == ["attic/"]
    assert texts("map_stats > a", session) == ["attic/"]
    assert texts("localize ", session) == ["zoo"]


def test_the_consoles_own_switches_can_be_set(session: Session) -> None:
    assert texts("set --complete_w", session) == ["--complete_while_typing"]
    assert not session.settings.is_on("complete_while_typing")
    session.set_flags(["complete_while_typing=true", "advice=false"])
    assert session.settings.is_on("complete_while_typing")
    assert not session.settings.is_on("advice")
    with pytest.raises(FlagError, match="wants true or false"):
        session.set_flags(["advice=perhaps"])


def test_only_the_flags_of_that_command_and_each_once(session: Session) -> None:
    assert texts("destroy --", session) == ["--yes"]
    assert "--ba_loss=" not in texts("solve --ba_loss=none --b", session)
    assert "--ba_num_iterations=" in texts("solve --ba_loss=none --b", session)


def test_flags_show_type_unit_and_default(session: Session) -> None:
    (candidate,) = complete("solve --ba_tol", session)
    assert candidate.help == "float [m] = 0.001  When to stop"


def test_commands_show_their_help(session: Session) -> None:
    (candidate,) = complete("slv", session)
    assert candidate.help == "Pretend to solve. (solve)"


def test_map_keys_and_missions(session: Session) -> None:
    from maplab_py.console.commands.registry import Plugin
    from maplab_py.plugin import CommandContext, Message, command

    @command("pick", needs_map=False)
    def pick(
        context: CommandContext,
        map_key: str = "",
        *,
        map_mission: str = "",
        map_mission_list: str = "",
    ) -> Message:
        """Pick."""
        return Message("")

    session.registry.add(pick.maplab_command, Plugin("p"))
    assert texts("pick v1", session) == ["v1_01", "v1_02"]
    assert texts("pick --map_key=02", session) == ["--map_key=v1_02"]
    assert texts("pick --map_mission=2", session) == [
        "--map_mission=" + "2" + "0" * 14 + "00000000000000007"
    ]
    head = "--map_mission_list=" + "1" * 32 + ","
    assert texts(f"pick {head}3", session)[0].startswith(head + "3000")


def test_paths(session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "maps one").mkdir()
    (tmp_path / "metadata").touch()
    (tmp_path / ".hidden").touch()
    monkeypatch.setenv("DATA", str(tmp_path))
    assert texts(f"solve --folder={tmp_path}/m", session) == [
        f"--folder={tmp_path}/maps\\ one/",
        f"--folder={tmp_path}/metadata",
    ]
    assert len(complete(f"solve --folder={tmp_path}/", session)) == 2
    assert len(complete("solve --folder $DATA/", session)) == 2
    assert complete("solve --folder=/no/such/folder/", session) == []


def test_a_candidate_replaces_the_word_it_completes(session: Session) -> None:
    line = "echo x; solve --ba_loss=c"
    (candidate,) = complete(line, session)
    assert line[: candidate.start] + candidate.text == "echo x; solve --ba_loss=cauchy"


@given(st.text(alphabet="solvehp-=_ '\"\\;#ab10/"))
def test_completion_never_fails(line: str) -> None:
    for candidate in complete(line, Session(REGISTRY)):
        assert 0 <= candidate.start <= len(line)


@given(st.text(alphabet="solvehp-=_ '\"\\;#ab10/"))
def test_colouring_keeps_every_character(line: str) -> None:
    assert "".join(text for _, text in coloured_parts(line, REGISTRY)) == line


def test_unknown_commands_and_flags_are_marked() -> None:
    styles = {text: style for style, text in coloured_parts("solve --ba_loss=x --y", REGISTRY)}
    assert styles["solve"] == "command"
    assert styles["--ba_loss="] == "flag"
    assert styles["x"] == "value"
    assert styles["--y"] == "unknown"
    assert coloured_parts("solvee", REGISTRY) == [("unknown", "solvee")]


def test_clear_clears_the_screen_and_is_proposed_before_clear_storage() -> None:
    session = Session(load_registry())
    session.maps.add("office", map_of(3))
    assert texts("clear", session) == ["clear", "clear_storage"]
    session.run("clear")
    assert len(session.maps) == 1
