"""The one exception tree. A message is one line for the user: what is wrong, where, and the remedy."""

from collections.abc import Iterator
from contextlib import contextmanager


class MaplabError(Exception):
    """Base class of all errors that maplab-py raises deliberately."""

    def __init__(self, *message: object, remedy: str = "") -> None:
        super().__init__(*message)
        # command line after which the refused command can be run again; empty if none is known
        self.remedy = remedy


class UserError(MaplabError):
    """The request cannot be carried out as given; the user can change it (exit status 2)."""


class FlagError(UserError):
    """A flag is unknown, misspelt, or has a value that does not fit its type."""


class MapError(UserError):
    """A map or one of its files is missing, damaged or inconsistent. Names file and field."""


class EstimationError(MaplabError):
    """An estimation problem has no usable answer: nothing to optimise, singular, or diverged."""


class Cancelled(MaplabError):
    """The user cancelled the running command (exit status 130)."""


@contextmanager
def os_errors_as(kind: type[MaplabError], what: str) -> Iterator[None]:
    """Raise an error that says what failed, with the reason of the operating system in brackets."""
    try:
        yield
    except OSError as error:
        raise kind(f"{what} ({error.strerror})") from error
