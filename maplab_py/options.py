"""Option groups: frozen dataclasses that declare flags once, with default, help, unit and range.

An algorithm takes its options class; a command that has a parameter of that type gets one flag per field,
named `flag_prefix` + field. The string after a field is its help, the end of its name is its unit::

    class FusionOptions(Options, prefix="tsdf_"):
        voxel_size_m: float = option(0.1, gt=0)
        \"""Side of a voxel\"""
"""

import ast
import dataclasses
import functools
import inspect
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, dataclass_transform

from maplab_py.errors import FlagError

_UNITS = {
    "_m": "m", "_meters": "m", "_s": "s", "_seconds": "s", "_ms": "ms", "_us": "us", "_ns": "ns",
    "_px": "px", "_deg": "deg", "_rad": "rad", "_hz": "Hz", "_gb": "GB", "_mps": "m/s",
    "_mps2": "m/s^2", "_radps": "rad/s",
}  # fmt: skip


def option(
    default: Any,
    *,
    help: str = "",
    unit: str = "",
    choices: Sequence[str] = (),
    flag: str = "",
    gt: float | None = None,
    ge: float | None = None,
    le: float | None = None,
    lt: float | None = None,
) -> Any:
    """Declare a field of an options class with its range, unit, choices or flag name.

    Args:
        default: Default value; its type must match the field's annotation.
        help: One sentence for the help page, where no string follows the field.
        unit: Unit of a number that the end of the name does not say.
        choices: Allowed values of a string option.
        flag: Full flag name when it is not prefix + field name (maplab's own spelling).
        gt: Number that the value must exceed; a value with a bound must be finite.
        ge: Smallest value.
        le: Largest value.
        lt: Number that the value must be below.
    """
    bounds = {"above": gt, "at least": ge, "at most": le, "below": lt}
    metadata = {"help": help, "unit": unit, "choices": tuple(choices), "flag": flag}
    given = {words: bound for words, bound in bounds.items() if bound is not None}
    return dataclasses.field(default=default, metadata={**metadata, "bounds": given})


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
class Options:
    """Base of option groups: makes each a frozen dataclass, and checks its values."""

    flag_prefix: ClassVar[str] = ""
    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    def __init_subclass__(cls, prefix: str | None = None) -> None:
        """Make the class a dataclass; its flags begin with the prefix, else as those of its base."""
        if prefix is not None:
            cls.flag_prefix = prefix
        dataclasses.dataclass(frozen=True)(cls)

    def __post_init__(self) -> None:
        """Check ranges and choices; a group with more to check does so, too.

        Raises:
            FlagError: A value is out of its range, or none of its choices.
        """
        for field in dataclasses.fields(self):
            value, choices = getattr(self, field.name), field.metadata.get("choices", ())
            said = violation(value, field.metadata.get("bounds", {}))
            if choices and value not in choices:
                said = f"must be one of {', '.join(filter(None, choices))}"
            if said:
                name = field.metadata["flag"] or self.flag_prefix + field.name
                text = value if isinstance(value, str) else f"{value:g}"
                raise FlagError(f"--{name}={text}: {said}")


def violation(value: Any, bounds: Mapping[str, float]) -> str:
    """Return what a value must be ("must be above 0"); empty if it is finite and keeps its bounds."""
    if not bounds or (
        math.isfinite(value)
        and value > bounds.get("above", -math.inf)
        and value >= bounds.get("at least", -math.inf)
        and value <= bounds.get("at most", math.inf)
        and value < bounds.get("below", math.inf)
    ):
        return ""
    words = [f"{words} {bound:g}" for words, bound in bounds.items()]
    return f"must be {' and '.join(words + ['finite'] * math.isinf(value))}"


def unit_of(field: dataclasses.Field[Any]) -> str:
    """Return the unit of an option: what its declaration or else the end of its name says."""
    unit: str = field.metadata.get("unit", "")
    return unit or _UNITS.get(field.name[field.name.rfind("_") :], "")


def help_of(group: type, field: dataclasses.Field[Any]) -> str:
    """Return the help of an option; the source file is read when the first help of it is asked for."""
    if field.metadata.get("help"):
        return str(field.metadata["help"])
    for owner in group.__mro__:
        if field.name in inspect.get_annotations(owner):
            return _strings_after_fields(owner.__module__).get((owner.__name__, field.name), "")
    return ""


@functools.cache
def _strings_after_fields(module: str) -> dict[tuple[str, str], str]:
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    classes = (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    return {(node.name, name): text for node in classes for name, text in _strings(node)}


def _strings(node: ast.ClassDef) -> Iterator[tuple[str, str]]:
    for field, following in zip(node.body, node.body[1:], strict=False):
        match field, following:
            case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                yield name, " ".join(text.split())
