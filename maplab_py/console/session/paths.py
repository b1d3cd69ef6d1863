"""Paths of the user's files: never in the current folder."""

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path

from maplab_py.atomic import write_file

_METADATA = Path("vi_map") / "vi_map_metadata"
_MOST_RECENT = 20


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
        lines = _recent_file().read_text(errors="replace").splitlines()
    except OSError:
        return []
    return [Path(line) for line in lines if (Path(line) / _METADATA).is_file()]


def remember_maps(folders: Iterable[Path]) -> None:
    """Put the folders of maps in front of the recent ones; not where the state folder cannot be written."""
    recent = dict.fromkeys(
        [*(str(folder.resolve()) for folder in folders), *map(str, recent_maps())]
    )
    lines = [path for path in recent if path.isprintable()][:_MOST_RECENT]
    with contextlib.suppress(OSError):
        state_folder().mkdir(parents=True, exist_ok=True)
        write_file(_recent_file(), ["".join(f"{line}\n" for line in lines).encode()])


def _recent_file() -> Path:
    return state_folder() / "recent_maps"
