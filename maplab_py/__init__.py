"""Visual-inertial mapping: maps of many sessions, their optimisation, and a console to work on them."""

__version__ = "0.1.0"
