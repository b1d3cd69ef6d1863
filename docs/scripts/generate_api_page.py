"""Write docs/python_api.md from the docstrings of what Python programs import.

python docs/scripts/generate_api_page.py
"""

import dataclasses
import importlib
import inspect
from functools import cached_property
from pathlib import Path
from typing import Any

import maplab_py.plugin
from maplab_py import Session, open_map
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import Table

PAGE = Path(__file__).resolve().parents[1] / "python_api.md"
_HEAD = """# Python API

<!-- made by docs/scripts/generate_api_page.py; do not edit -->

```python
import maplab_py

with maplab_py.open_map("maps/office") as session:
    report = session.lc(lc_min_inlier_count=15)  # every command is a method, every flag a keyword
    print(report.as_dict())  # a report has fields; as_dict() is the report of --json
    vi_map = session.vi_map  # a value: tables of read-only numpy arrays
    print(vi_map.T_G_I[:, 4:].mean(axis=0))  # mean position of the vertices
    session.undo()
```

[Commands](commands/index.md) lists the methods of a session, [notation](notation.md) the frames and the order
of tangents. `maplab_py.plugin` has a version, `API_VERSION`; [writing plugins](writing_plugins.md) says what
stays compatible. The [notebook](notebooks/multi_session.ipynb) repeats the workflow of several sessions in
Python.
"""


def page() -> str:
    """Return the text of the page."""
    parts = [
        _HEAD,
        "## maplab_py\n\n" + _list([("`open_map(folder, **flags)`", open_map)]),
        "## Session\n\n" + _list(_members(Session)),
        "## VIMap\n\n" + _list(_members(VIMap)),
        "## Tables of a map\n\nEach is an attribute of `VIMap`; a column has one row per entity.\n\n"
        + _tables_of_a_map(),
        "## maplab_py.plugin\n\n"
        + _list([(f"`{name}`", getattr(maplab_py.plugin, name)) for name in _exported()]),
    ]
    return "\n".join(parts)


def _exported() -> list[str]:
    return [name for name in maplab_py.plugin.__all__ if not name.isupper()]


def _members(kind: type) -> list[tuple[str, Any]]:
    """Return name and object of the public methods and properties that a class documents itself."""
    members = []
    for name, value in vars(kind).items():
        if name.startswith("_"):
            continue
        if inspect.isfunction(value):
            members.append((f"`{name}{_parameters(value)}`", value))
        elif isinstance(value, (property, cached_property)):
            members.append((f"`{name}`", value))
    return members


def _parameters(function: Any) -> str:
    names = []
    for parameter in list(inspect.signature(function).parameters.values())[1:]:
        star = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
        names.append(star + parameter.name)
    return f"({', '.join(names)})"


def _tables_of_a_map() -> str:
    module = importlib.import_module("maplab_py.vimap")
    lines = ["| table | contents | columns |", "|---|---|---|"]
    for field in dataclasses.fields(VIMap):
        table = getattr(module, str(field.type), None)
        if not (isinstance(table, type) and issubclass(table, Table)):
            continue
        columns = ", ".join(f"`{column.name}`" for column in dataclasses.fields(table))
        lines.append(f"| `{field.name}` | {_summary(table)} | {columns} |")
    return "\n".join(lines) + "\n"


def _list(rows: list[tuple[str, Any]]) -> str:
    return "".join(f"- {name}: {_summary(value)}\n" for name, value in rows)


def _summary(value: Any) -> str:
    """Return the first paragraph of a docstring in one line."""
    text = (inspect.getdoc(value) or "").split("\n\n")[0]
    return " ".join(text.split()).replace("``", "`").replace("|", "\\|")


def main() -> None:
    """Rewrite the page."""
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
