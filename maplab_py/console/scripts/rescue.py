"""Maps that a script leaves unsaved are kept in the user's state folder, where `recover` finds them."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

from maplab_py.console.session.paths import state_folder
from maplab_py.console.session.session import Session

MOST_RUNS = 5
"""Older rescued maps are deleted: a script that fails every night must not fill the disk."""


def rescue_folder() -> Path:
    """Return the folder with one sub-folder per script that left maps unsaved."""
    return state_folder() / "rescued"


def rescued_runs() -> list[Path]:
    """Return the folders of scripts that left maps unsaved, the newest last."""
    folder = rescue_folder()
    return sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []


def rescue_unsaved(session: Session) -> Path:
    """Save the maps of a session that are on no disk and return the folder they are in.

    Raises:
        MaplabError: A map cannot be written.
    """
    stamp = time.strftime("%Y-%m-%d_%H-%M-%S", time.gmtime())
    run = rescue_folder() / f"{stamp}_{os.getpid()}"
    for entry in session.maps.unsaved:
        session.maps.select(entry.key)
        session.run("save", map_folder=run / entry.key)
    for old in rescued_runs()[:-MOST_RUNS]:
        shutil.rmtree(old, ignore_errors=True)
    return run
