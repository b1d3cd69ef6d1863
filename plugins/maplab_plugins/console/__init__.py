"""Commands of the console itself: help, lasting flags, aliases, jobs, timing, transcript, plugins."""

from maplab_plugins.console.aliases import alias, list_flags, set_flags, unalias, unset_flags
from maplab_plugins.console.help import list_plugins, show_help, show_schema
from maplab_plugins.console.jobs import cancel, join, list_jobs
from maplab_plugins.console.session import (
    check,
    clear_screen,
    enable_sheep,
    fix,
    new_plugin,
    show_timing,
    transcript,
    watch,
)

__all__ = [
    "alias",
    "cancel",
    "check",
    "clear_screen",
    "enable_sheep",
    "fix",
    "join",
    "list_flags",
    "list_jobs",
    "list_plugins",
    "new_plugin",
    "set_flags",
    "show_help",
    "show_schema",
    "show_timing",
    "transcript",
    "unalias",
    "unset_flags",
    "watch",
]
