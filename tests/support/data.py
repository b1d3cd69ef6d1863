"""Where tests find the real recordings; nothing of them is part of the project."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


def shared_data(relative: str = "") -> Path:
    """Return the path of a real data file or folder; skip the test when it is not there."""
    configured = os.environ.get("MAPLAB_SHARED_DATA", "")
    root = Path(configured) if configured else REPOSITORY.parent / "shared" / "data"
    path = root / relative
    if not path.exists():
        pytest.skip(f"real data '{relative}' is not on this machine (set MAPLAB_SHARED_DATA)")
    return path
