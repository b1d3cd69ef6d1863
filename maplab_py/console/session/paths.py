"""Paths of the user's files: never in the current folder."""

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path

from maplab_py.atomic import write_file
from maplab_py.errors import UserError

_METADATA = Path("vi_map") / "vi_map_metadata"
_RECENT, _MOST_RECENT = "recent_maps", 20


def state_folder() -> Path:
    """Return the folder of history and logs ($XDG_STATE_HOME/maplab)."""
    base = os.environ.get("XDG_STATE_HOME", "")
    return (Path(base) if base else Path.home() / ".local" / "state") / "maplab"


def user_flagfile() -> Path:
    """Return the flag file that every session of this user reads ($XDG_CONFIG_HOME/maplab/flags)."""
    base = os.environ.get("XDG_CONFIG_HOME", "")
    return (Path(base) if base else Path.home() / ".config") / "maplab" / "flags"


def user_aliases() -> Path:
    """Return the file of aliases that every session reads ($XDG_CONFIG_HOME/maplab/aliases)."""
    return user_flagfile().with_name("aliases")


def recent_maps() -> list[Path]:
    """Return the folders of maps that were loaded or saved last and are still there, latest first."""
    try:
        lines = (state_folder() / _RECENT).read_text(errors="replace").splitlines()
    except OSError:
        return []
    return [Path(line) for line in lines if (Path(line) / _METADATA).is_file()]


def remember_maps(folders: Iterable[Path]) -> None:
    """Put the folders of maps in front of the recent ones."""
    recent = dict.fromkeys(
        [*(str(folder.resolve()) for folder in folders), *map(str, recent_maps())]
    )
    lines = [path for path in recent if path.isprintable()][:_MOST_RECENT]
    write_state(_RECENT, "".join(f"{line}\n" for line in lines))


def write_state(name: str, text: str) -> None:
    """Write a file of the state folder if it can be written: what it holds is a convenience."""
    with contextlib.suppress(OSError, UserError):
        state_folder().mkdir(parents=True, exist_ok=True)
        write_file(state_folder() / name, [text.encode()])
