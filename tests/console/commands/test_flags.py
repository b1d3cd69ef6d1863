"""From a signature to a command, from words on a line to typed values, and maplab's names of flags."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.console.commands.command import describe
from maplab_py.console.commands.flag_types import FLOAT, expand_path, flag_type, format_value
from maplab_py.console.commands.flags import (
    Flag,
    explanation,
    former_flags,
    parse_table,
    parse_words,
)
from maplab_py.errors import FlagError, UserError
from maplab_py.options import option
from maplab_py.plugin import CommandContext, command
from tests.console.sample_plugin import Colour, SolverOptions, make_session, solve


def test_flags_carry_type_default_unit_and_help() -> None:
    flags = solve.maplab_command.flags
    assert list(flags) == [
        "name",
        "ba_num_iterations",
        "ba_tolerance_m",
        "ba_loss",
        "fix_gravity",
        "inner_depth",
        "colour",
        "mode",
        "limit",
        "folder",
        "factors",
    ]
    assert flags["ba_tolerance_m"].unit == "m"
    assert flags["ba_tolerance_m"].default_text == "0.001"
    assert flags["ba_loss"].type.choices == ("huber", "cauchy", "none")
    assert flags["colour"].type.choices == ("red", "deep_blue")
    assert flags["name"].help == "A name, described on two lines"
    assert flags["limit"].help == "An upper limit"


def test_summary_and_description_come_from_the_docstring() -> None:
    described = solve.maplab_command
    assert described.summary == "Pretend to solve."
    assert described.description == "More words about it."
    assert described.names == ("solve", "s", "slv")


def test_the_function_stays_a_plain_function() -> None:
    report = solve(None, "x", options=SolverOptions(num_iterations=3))  # type: ignore[arg-type]
    assert report.options.num_iterations == 3
    assert report.name == "x"


def test_bind_changes_only_what_is_given_even_in_nested_groups() -> None:
    arguments = solve.maplab_command.bind({"inner_depth": 5, "ba_loss": "none"})
    options = arguments["options"]
    assert (options.inner.depth, options.loss, options.num_iterations) == (5, "none", 10)
    assert arguments["colour"] is Colour.RED


def test_an_option_group_that_refuses_its_values_is_a_flag_error() -> None:
    with pytest.raises(FlagError, match="--ba_num_iterations cannot be negative"):
        make_session().run("solve", ba_num_iterations=-1)


@dataclasses.dataclass(frozen=True)
class ClashingOptions:
    """Brings a flag that SolverOptions has too."""

    flag_prefix: ClassVar[str] = "ba_"
    loss: str = option("huber", help="")


def _same_flag_twice(
    context: CommandContext,
    *,
    a: SolverOptions = SolverOptions(),  # noqa: B008
    b: ClashingOptions = ClashingOptions(),
) -> None:
    """Do something."""


def _reserved_flag(context: CommandContext, *, flagfile: str = "") -> None:
    """Do something."""


def _impossible_type(context: CommandContext, *, table: dict[str, int]) -> None:
    """Do something."""


def _no_type(context: CommandContext, *, value=3) -> None:  # type: ignore[no-untyped-def]
    """Do something."""


def _no_docstring(context: CommandContext) -> None:
    pass


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (_same_flag_twice, "--ba_loss is defined twice"),
        (_reserved_flag, "--flagfile is defined twice"),
        (_impossible_type, "cannot have the type"),
        (_no_type, "value needs a type"),
        (_no_docstring, "no docstring"),
    ],
)
def test_a_signature_that_is_no_command_is_refused_at_registration(
    function: Callable[..., Any], message: str
) -> None:
    with pytest.raises(TypeError, match=message):
        command("broken")(function)


def test_a_return_type_known_to_checkers_alone_does_no_harm() -> None:
    def lazy(context: CommandContext, *, folder: Path | None = None) -> "NotImported":  # type: ignore[name-defined]  # noqa: F821, UP037
        """Return something heavy."""

    described = describe(lazy, "lazy", ())
    assert described.flags["folder"].type.name == "path"


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


FLAGS = {"image_scale": Flag("image_scale", FLOAT, 1.0)}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "rovioli_use_6dof_localization",
            r"^rovioli has no flag --rovioli_use_6dof_localization: here it is "
            r"--localization_mode \(pose instead of vil\)$",
        ),
        (
            "visualize_map",
            "^rovioli has no flag --visualize_map: here it is --rovioli_visualize_map$",
        ),
        (
            "set_imu_bias_to_zero",
            "^rovioli has no flag --set_imu_bias_to_zero: maplab's flag is not needed here: "
            "biases are estimated$",
        ),
        ("image_scal", "^rovioli has no flag --image_scal; did you mean --image_scale"),
    ],
)
def test_an_unknown_flag_is_explained(name: str, message: str) -> None:
    with pytest.raises(FlagError, match=message):
        parse_words([f"--{name}=1"], FLAGS, "rovioli")


def test_reasons_continue_the_sentence() -> None:
    for name, flag in former_flags().items():
        text = explanation(name)
        assert text.startswith(": ")
        assert not text.endswith(".")
        assert (flag.new_name or flag.note) in text
    assert explanation("lc_of_nowhere") == ""


@pytest.mark.parametrize(
    "line", ["a\tdropped\t", "a\trenamed\t", "a, a\tdropped\tno", "a\tkept\tno", "a"]
)
def test_a_wrong_table_is_refused(line: str) -> None:
    with pytest.raises(ValueError, match=r"'?a'?|unpack|kept"):
        parse_table(line)
