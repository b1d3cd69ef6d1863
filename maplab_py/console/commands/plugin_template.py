"""The files of a new plugin distribution: one command, one test, a README."""

import re
from string import Template

from maplab_py.errors import UserError

_NAME = re.compile(r"^[a-z][a-z0-9_]*$")

_PYPROJECT = """\
[build-system]
requires = ["hatchling>=1.24"]
build-backend = "hatchling.build"

[project]
name = "$distribution"
version = "0.1.0"
description = "maplab-py commands: $name"
readme = "README.md"
requires-python = ">=3.11"
dependencies = ["maplab-py>=$version"]

[project.optional-dependencies]
test = ["pytest"]

[project.entry-points."maplab_py.plugins"]
$name = "$package"

[tool.hatch.build.targets.wheel]
packages = ["$package"]
"""

_MODULE = '''\
"""Commands of the plugin $name."""

import numpy as np

from maplab_py.plugin import CommandContext, Report, UserError, command


class PathLengths(Report):
    """Result of the command: printed as a table, or as JSON with --json."""

    missions: int
    longest_m: float
    total_m: float


@command("$name", example="$name --max_step_m=1.0")
def $name(context: CommandContext, *, max_step_m: float = 10.0) -> PathLengths:
    """Measure the lengths of the missions' paths.

    Args:
        max_step_m: Leave out steps between vertices that are longer, in metres.
    """
    if max_step_m <= 0:
        raise UserError("$name: --max_step_m must be greater than 0")
    vi_map = context.vi_map  # a value: tables of numpy arrays that nobody can change
    p_G_I = vi_map.T_G_I[:, 4:]
    step_m = np.linalg.norm(np.diff(p_G_I, axis=0), axis=1)
    mission = vi_map.vertices.mission
    counts = (mission[1:] == mission[:-1]) & (step_m <= max_step_m)
    lengths_m = np.zeros(len(vi_map.missions))
    np.add.at(lengths_m, mission[1:][counts], step_m[counts])
    return PathLengths(len(lengths_m), float(lengths_m.max(initial=0.0)), float(lengths_m.sum()))
'''

_TEST = '''\
"""The command on a small simulated map."""

from __future__ import annotations

from pathlib import Path

import pytest

from maplab_py import Session
from maplab_py.plugin import UserError

SCENARIO = """
name: small
world: {landmarks_per_room: 300}
measurement: {frame_rate_hz: 2.0, max_keypoints: 50}
sessions:
  - {kind: loop, duration_s: 10.0}
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder: Path = tmp_path_factory.mktemp("data")
    (folder / "scenario.yaml").write_text(SCENARIO)
    session = Session()
    scenario = str(folder / "scenario.yaml")
    session.run("simulate", scenario=scenario, map_folder=folder / "maps")
    session.run("load_merge_all_maps", maps_folder=folder / "maps")
    return session


def test_lengths(session: Session) -> None:
    report = session.run("$name")
    assert report.missions == 1
    assert 0.5 < report.longest_m == report.total_m < 30.0


def test_nonsense_is_refused(session: Session) -> None:
    with pytest.raises(UserError, match="max_step_m"):
        session.run("$name", max_step_m=-1.0)
'''

_README = """\
# $distribution

A plugin for maplab-py with the command `$name`.

```
pip install .            # or: pip install -e .
maplab help $name
pip install '.[test]' && pytest
```

The command is a function in `$package/__init__.py`: its keyword parameters are its flags, its
docstring is its help page, what it returns is its report. Write more of them beside it.
"""


def plugin_files(name: str, version: str) -> dict[str, str]:
    """Return the text of every file of a new plugin by its path.

    Args:
        name: Name of the plugin and of its first command.
        version: The version of maplab-py that it needs at least.

    Raises:
        UserError: The name is no Python name of small letters.
    """
    name = name.replace("-", "_")
    if not _NAME.match(name):
        raise UserError(
            f"new_plugin: '{name}' cannot be a name: use lower-case letters, digits and _"
        )
    package = f"maplab_{name}"
    words = {
        "name": name,
        "package": package,
        "distribution": package.replace("_", "-"),
        "version": version,
    }
    templates = {
        "pyproject.toml": _PYPROJECT,
        "README.md": _README,
        f"{package}/__init__.py": _MODULE,
        f"{package}/py.typed": "",
        f"tests/test_{name}.py": _TEST,
    }
    return {path: Template(text).substitute(words) for path, text in templates.items()}
