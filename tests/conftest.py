"""Settings of all tests."""

from __future__ import annotations

from hypothesis import settings

# how long a case takes says more of the machine's other work than of ours
settings.register_profile("maplab", deadline=None)
settings.load_profile("maplab")
