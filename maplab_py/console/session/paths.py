"""Paths of the user's files: never in the current folder."""

import os
from pathlib import Path


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
