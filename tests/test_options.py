"""Declarations of option groups: default, help, unit and range stand once."""

from __future__ import annotations

import dataclasses

import pytest

from maplab_py.errors import FlagError
from maplab_py.options import Options, help_of, option, unit_of


class Base(Options, prefix="base_"):
    """Options."""

    side_m: float = option(0.1, gt=0)
    """Side of a
    voxel."""
    drift_deg: float = option(0.4, ge=0, le=1, unit="deg/sqrt(s)", flag="drift")
    """Drift."""
    name: str = "a"


class Derived(Base):
    """More of them."""

    count: int = option(3, help="Number")


def test_help_and_unit_follow_the_declaration() -> None:
    fields = dataclasses.fields(Derived)
    assert [help_of(Derived, field) for field in fields] == [
        "Side of a voxel.",
        "Drift.",
        "",
        "Number",
    ]
    assert [unit_of(field) for field in fields] == ["m", "deg/sqrt(s)", "", ""]
    assert Derived.flag_prefix == "base_"


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("side_m", 0.0, "--base_side_m=0: must be above 0"),
        ("side_m", float("nan"), "--base_side_m=nan: must be above 0"),
        ("side_m", float("inf"), "--base_side_m=inf: must be above 0 and finite"),
        ("drift_deg", 2.0, "--drift=2: must be at least 0 and at most 1"),
    ],
)
def test_values_out_of_range_name_their_flag(name: str, value: float, said: str) -> None:
    with pytest.raises(FlagError) as caught:
        dataclasses.replace(Derived(), **{name: value})
    assert str(caught.value) == said


def test_options_are_frozen_values() -> None:
    options = Derived(side_m=1.0)
    assert options == Derived(side_m=1.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        options.side_m = 2.0  # type: ignore[misc]
