"""Commands of the console itself: help, lasting flags, aliases, jobs, timing, transcript, plugins."""

from maplab_plugins.console import aliases, jobs, session
from maplab_plugins.console import help as help_pages

__all__ = ["aliases", "help_pages", "jobs", "session"]
