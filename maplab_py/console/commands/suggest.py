"""Suggestions for misspelt names."""

from collections.abc import Iterable

from maplab_py.errors import UserError


def nearest(word: str, known: Iterable[str], count: int = 3) -> list[str]:
    """Return up to `count` known names that look like `word`, best first."""
    import difflib

    names = list(dict.fromkeys(known))
    close = difflib.get_close_matches(word, names, n=count, cutoff=0.6)
    if len(word) >= 3:
        close += [name for name in names if name.startswith(word) and name not in close]
    return close[:count]


def did_you_mean(word: str, known: Iterable[str], decoration: str = "") -> str:
    """Return "; did you mean a, b?" for a misspelt word, empty when nothing is near.

    Args:
        word: What the user typed.
        known: All valid names.
        decoration: Put before every proposed name ("--" for flags).
    """
    close = [decoration + name for name in nearest(word, known)]
    return f"; did you mean {', '.join(close)}?" if close else ""


def unknown(kind: str, word: str, known: Iterable[str], hint: str = "") -> UserError:
    """Return the error for a name that is not known, with the nearest ones, else with `hint`."""
    proposal = did_you_mean(word, list(known))
    return UserError(f"unknown {kind} '{word}'{proposal or (f'; {hint}' if hint else '')}")
