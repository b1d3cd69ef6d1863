"""Where tests find the real recordings; nothing of them is part of the project."""

import os
from pathlib import Path

import pytest

from tests.support.coverage import NO_DATA

REPOSITORY = Path(__file__).resolve().parents[2]


def shared_data_folder() -> Path:
    """Return the folder of the real recordings, whether or not it is there."""
    configured = os.environ.get("MAPLAB_SHARED_DATA", "")
    return Path(configured) if configured else REPOSITORY.parent / "shared" / "data"


def shared_data(relative: str = "") -> Path:
    """Return the path of a real data file or folder; skip the test when it is not there."""
    path = shared_data_folder() / relative
    if not path.exists():
        pytest.skip(f"{NO_DATA}: '{relative}' is not on this machine (set MAPLAB_SHARED_DATA)")
    return path
