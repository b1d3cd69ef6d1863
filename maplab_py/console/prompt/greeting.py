"""Greeting of the prompt: the version, one hint, and the maps that were opened last."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path

_MAP_WORDS = ("--map_folder=", "--save_map_folder=")
_COMMANDS = ("load", "save", "rovioli")
_METADATA = Path("vi_map") / "vi_map_metadata"
_MAX_MAPS = 3


def greeting(history: Sequence[str]) -> list[str]:
    """Return what the prompt says first.

    Args:
        history: Lines that were typed before, oldest first.
    """
    lines = [f"maplab-py {version('maplab-py')} · help lists tasks and commands · Tab completes"]
    maps = list(dict.fromkeys(_maps_of(history)))[:_MAX_MAPS]
    if maps:
        lines.append("recent maps: " + " · ".join(f"load {shlex.quote(path)}" for path in maps))
    return lines


def _maps_of(history: Sequence[str]) -> Iterator[str]:
    """Yield the map folders of loaded and saved maps that are still there, latest first."""
    for line in reversed(history):
        for text in reversed(line.split(";")):
            try:
                words = shlex.split(text)
            except ValueError:
                continue
            if not words or words[0] not in _COMMANDS:
                continue
            for word in words[1:]:
                named = next((word[len(f) :] for f in _MAP_WORDS if word.startswith(f)), "")
                path = named or ("" if word.startswith("-") else word)
                if path and (Path(path) / _METADATA).is_file():
                    yield path
