"""Words on a line to typed values."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.console.commands.flag_types import expand_path, flag_type, format_value
from maplab_py.errors import FlagError, UserError
from tests.console.sample_plugin import Colour, SolverOptions, make_session


def values(line: str) -> dict[str, Any]:
    return dict(make_session().parse(line.split()).values)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--ba_num_iterations=3", {"ba_num_iterations": 3}),
        ("--ba_num_iterations 3", {"ba_num_iterations": 3}),
        ("-ba_num_iterations 3", {"ba_num_iterations": 3}),
        ("-ba_num_iterations=3", {"ba_num_iterations": 3}),
        ("--ba-num-iterations=3", {"ba_num_iterations": 3}),
        ("--ba_num_iterations=3 --ba_num_iterations=4", {"ba_num_iterations": 4}),
        ("--ba_tolerance_m -1.5", {"ba_tolerance_m": -1.5}),
        ("--ba_tolerance_m -.5", {"ba_tolerance_m": -0.5}),
        ("--fix_gravity", {"fix_gravity": True}),
        ("--nofix_gravity", {"fix_gravity": False}),
        ("--no-fix-gravity", {"fix_gravity": False}),
        ("--fix_gravity=false", {"fix_gravity": False}),
        ("--fix_gravity false", {"fix_gravity": False}),
        ("--colour=deep-blue", {"colour": Colour.DEEP_BLUE}),
        ("--colour=b", {"colour": Colour.DEEP_BLUE}),
        ("--mode=exact", {"mode": "exact"}),
        ("--limit=", {"limit": None}),
        ("--limit=inf", {"limit": math.inf}),
        ("--factors=1,2.5", {"factors": (1.0, 2.5)}),
        ("abc", {"name": "abc"}),
        ("--name=abc", {"name": "abc"}),
        ("-- -abc", {"name": "-abc"}),
    ],
)
def test_forms_of_flags(words: str, expected: dict[str, Any]) -> None:
    assert values(f"solve {words}") == expected


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("solve --ba_num_iteration=3", "did you mean --ba_num_iterations"),
        ("solve --ba_num_iterations", "--ba_num_iterations needs a value"),
        ("solve --ba_num_iterations --mode=fast", "--ba_num_iterations needs a value"),
        ("solve --ba_num_iterations=1.5", "wants a whole number"),
        ("solve --ba_num_iterations=", "wants a whole number"),
        ("solve --ba_tolerance_m=nan", "not nan"),
        ("solve --ba_tolerance_m=x", "wants a number"),
        ("solve --ba_loss=hubr", "did you mean huber"),
        ("solve --colour=redd", "did you mean red"),
        ("solve --fix_gravity=maybe", "wants true or false"),
        ("solve --nofix_gravity=true", "takes no value"),
        ("solve a b", "unexpected word 'b'"),
        ("solve a && solve b", "commands are separated by ;"),
        ("solve --v=x", "wants a whole number"),
        ("solv", "did you mean solve"),
    ],
)
def test_mistakes_are_one_line_with_the_remedy(line: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        values(line)
    assert "\n" not in str(error.value)


def test_paths_expand_home_and_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    assert values("solve --folder=~/maps/a") == {"folder": Path("/home/somebody/maps/a")}
    assert values("solve --folder=maps/$x") == {
        "folder": Path("maps/$x")
    }  # expanded before, unless quoted
    monkeypatch.setenv("MAPS", "maps")
    assert expand_path("~/$MAPS/a") == Path("/home/somebody/maps/a")
    with pytest.raises(ValueError, match="environment variable"):
        expand_path("$MAPLAB_TEST_UNSET_VARIABLE/a")


@pytest.mark.parametrize(
    ("folder", "message"),
    [
        ("a\0b", "cannot contain the character NUL"),
        ("a/" + "n" * 256, "a name in it 255"),
        ("a/" + "ö" * 128, "a name in it 255"),
        ("long/" * 1000, "at most 4095 bytes"),
    ],
)
def test_paths_that_no_file_system_takes(folder: str, message: str) -> None:
    with pytest.raises(FlagError, match=message) as error:
        make_session().run("solve", folder=folder)
    assert "\n" not in str(error.value)


def test_python_values_pass_and_wrong_ones_do_not() -> None:
    session = make_session()
    report = session.run("solve", "abc", ba_loss="cauchy", limit=2, colour=Colour.DEEP_BLUE)
    assert (report.name, report.options.loss, report.limit) == ("abc", "cauchy", 2)  # type: ignore[attr-defined]
    report = session.run("solve", options=SolverOptions(num_iterations=1), ba_loss="none")
    assert report.options == SolverOptions(num_iterations=1, loss="none")  # type: ignore[attr-defined]
    with pytest.raises(FlagError, match="whole number"):
        session.run("solve", ba_num_iterations=1.5)
    with pytest.raises(FlagError, match="did you mean --ba_loss"):
        session.run("solve", ba_los="none")
    with pytest.raises(FlagError, match="must be a SolverOptions"):
        session.run("solve", options=3)


@given(st.floats(allow_nan=False))
def test_numbers_survive_formatting(value: float) -> None:
    assert flag_type(float).parse(format_value(value)) == value


@pytest.mark.parametrize(
    ("annotation", "value"),
    [
        (bool, True),
        (int, -3),
        (str, "a b"),
        (Path, Path("a/b")),
        (int | None, None),
        (tuple[int, ...], (1, 2)),
        (Colour, Colour.DEEP_BLUE),
    ],
)
def test_every_type_reads_what_it_writes(annotation: Any, value: Any) -> None:
    assert flag_type(annotation).parse(format_value(value)) == value
