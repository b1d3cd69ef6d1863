"""Programs of the tests that run in a process of their own."""

import sys

from tests.support.data import REPOSITORY

_RUN = (
    "import runpy, sys; count = int(sys.argv.pop(1)); sys.path += sys.argv[1 : 1 + count]; "
    "del sys.argv[1 : 1 + count]; runpy.run_module(sys.argv.pop(1), run_name='__main__', "
    "alter_sys=True)"
)


def module_program(name: str, *folders: str) -> list[str]:
    """Return the command that runs a module as `python -m` does, with more folders to search.

    The folders come last on the search path: the installed package is the package that runs,
    whether or not `PYTHONSAFEPATH` is set.
    """
    return [sys.executable, "-c", _RUN, str(len(folders)), *folders, name]


def module_of_tests(name: str) -> list[str]:
    """Return the command that runs a module of the tests."""
    return module_program(name, str(REPOSITORY))
