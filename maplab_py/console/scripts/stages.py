"""Stages of a batch file, read into a pipeline."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from maplab_py.errors import UserError
from maplab_py.pipeline.plan import Stage

_KEYS = {"name", "each", "all", "commands", "memory_gb"}


def read_stages(value: Any, path: Path) -> tuple[Stage, ...]:
    """Read the value of the key `stages`.

    Args:
        value: What the file holds there.
        path: The file, for messages.

    Raises:
        UserError: It is no list of stages, or a stage has a wrong or unknown key.
    """
    if not isinstance(value, list) or not value:
        raise UserError(f"{path}: stages is not a list of stages")
    return tuple(_read_stage(entry, number, path) for number, entry in enumerate(value, start=1))


def _read_stage(entry: Any, number: int, path: Path) -> Stage:
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
        raise UserError(f"{path}: stage {number} has no name")
    name = entry["name"]
    if unknown := {str(key) for key in entry} - _KEYS:
        raise UserError(f"{path}: stage {name}: unknown key '{min(unknown)}'")
    each = entry.get("each", "")
    if not isinstance(each, str):
        raise UserError(f"{path}: stage {name}: 'each' is not the name of one stage")
    memory_gb = entry.get("memory_gb", 0.0)
    if isinstance(memory_gb, bool) or not isinstance(memory_gb, (int, float)):
        raise UserError(f"{path}: stage {name}: memory_gb is not a number")
    commands = _words(entry.get("commands", []), f"{path}: stage {name}: commands")
    sources = _words(entry.get("all", []), f"{path}: stage {name}: all")
    return Stage(name, commands, each, sources, float(memory_gb))


def _words(value: Any, place: str) -> tuple[str, ...]:
    values = [value] if isinstance(value, str) else value
    if not isinstance(values, list) or not all(isinstance(word, str) for word in values):
        raise UserError(f"{place} is not a list of strings")
    return tuple(values)
