"""Option groups: frozen dataclasses whose fields carry help and unit, so that a default is written once.

An algorithm takes its options dataclass; a command that has a parameter of that type gets one
flag per field, named ``<flag_prefix><field name>``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any


def option(
    default: Any,
    *,
    help: str,
    unit: str = "",
    choices: Sequence[str] = (),
    flag: str = "",
) -> Any:
    """Declare one field of an options dataclass.

    Args:
        default: Default value; its type must match the field's annotation.
        help: One sentence for the help page.
        unit: Unit of a number ("m", "deg", "px", "s"); empty when it has none.
        choices: Allowed values of a string option.
        flag: Full flag name when it is not prefix + field name (maplab's own spelling).
    """
    return dataclasses.field(
        default=default,
        metadata={"help": help, "unit": unit, "choices": tuple(choices), "flag": flag},
    )
