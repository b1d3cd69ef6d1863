"""From a function's signature to a command."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest

from maplab_py.console.commands.command import describe
from maplab_py.errors import FlagError
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
