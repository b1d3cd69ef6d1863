"""Reports: what an algorithm found, as small dataclasses of numbers that a user would ask for."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Report:
    """Base of every report. Subclasses are frozen dataclasses; fields are the facts.

    A report that describes a failure (an inconsistent map, nothing found) overrides `failure`:
    the console then prints the report and the command's status is 1.
    """

    @property
    def failure(self) -> str:
        """One line that says why the command failed although it ran; empty when it succeeded."""
        return ""

    def as_json(self) -> dict[str, Any]:
        """Return the report's fields as plain JSON types."""
        return {f.name: to_json(getattr(self, f.name)) for f in dataclasses.fields(self)}


@dataclasses.dataclass(frozen=True)
class Message(Report):
    """A report of one sentence."""

    text: str


def to_json(value: Any) -> Any:
    """Convert dataclasses, numpy values, paths and enums to plain JSON types."""
    if isinstance(value, Report):
        return value.as_json()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return to_json(value.tolist())
    if isinstance(value, np.generic):
        return to_json(value.item())
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [to_json(item) for item in value]
    if isinstance(value, Enum):
        return value.name.lower()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
