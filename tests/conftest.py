"""Settings of all tests."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

from tests.support.coverage import not_run_here

# how long a case takes says more of the machine's other work than of ours
# the same cases in every run; --hypothesis-profile=search looks for new ones
settings.register_profile("maplab", deadline=None, derandomize=True)
settings.register_profile("search", deadline=None, max_examples=1000)
settings.load_profile("maplab")

# programs that tests start import the package that is tested, not that of the working folder
os.environ.setdefault("PYTHONSAFEPATH", "1")

_MOST_PROCESSES = 4
"""Each takes up to 1.5 GB."""


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Use all processors for whole folders of tests; single files run in this process."""
    paths = [Path(word.split("::")[0]) for word in config.args]
    if not all(path.is_dir() for path in paths):
        return 0
    processors = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    )
    return min(processors or 1, _MOST_PROCESSES) if (processors or 1) > 1 else 0


def pytest_pycollect_makeitem(name: str, obj: object) -> list[pytest.Item] | None:
    """Leave out functions of the product that a test imports and that begin with `test_`."""
    module = str(getattr(obj, "__module__", ""))
    return [] if module.partition(".")[0] in ("maplab_py", "maplab_plugins") else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files of slow tests: else one process is alone with them at the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Before processes start: compile each kernel once for all of them."""
    option = session.config.option
    if getattr(option, "numprocesses", 0) and not option.collectonly:
        from tests.support.kernels import compiled_ahead

        reporter = session.config.pluginmanager.get_plugin("terminalreporter")
        if (text := compiled_ahead()) and reporter is not None:
            reporter.write_line(text)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Tell what green does not cover."""
    skipped = terminalreporter.stats.get("skipped", [])
    reasons = [one.longrepr[2] for one in skipped if isinstance(one.longrepr, tuple)]
    terminalreporter.write_line(not_run_here(reasons))
