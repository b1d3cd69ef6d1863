"""A tour of the console: ten minutes at the prompt, every step typed by the user and checked."""

from maplab_plugins.tour.command import tour

__all__ = ["tour"]
