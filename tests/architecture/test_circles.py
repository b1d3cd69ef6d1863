"""No import leads back to where it came from: not among modules, nor among the parts of a package.

Imports inside functions count. Imports for type checkers alone (`if TYPE_CHECKING:`) do not: they
let two classes name each other in annotations.
"""

from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter

import grimp
import pytest

PACKAGES = ("maplab_py", "maplab_plugins")
Graph = Mapping[str, set[str]]


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """Return the modules that every module imports."""
    graph = grimp.build_graph(*PACKAGES, exclude_type_checking_imports=True, cache_dir=None)
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


def circle(graph: Graph) -> list[str]:
    """Return the names along one circle, none if there is no circle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def parts_of_packages(imports: Graph) -> Iterator[tuple[str, Graph]]:
    """Yield every package with the imports among its direct parts."""
    packages = {module.rpartition(".")[0] for module in imports} - {""}
    for package in sorted(packages):
        parts: dict[str, set[str]] = {}
        for module, imported in imports.items():
            part = _part(package, module)
            if part:
                others = {_part(package, name) for name in imported} - {part, ""}
                parts.setdefault(part, set()).update(others)
        yield package, parts


def _part(package: str, module: str) -> str:
    """Return the direct part of a package that a module belongs to, empty if it is outside."""
    inside = package + "."
    return module.removeprefix(inside).split(".")[0] if module.startswith(inside) else ""


def test_modules_import_in_no_circle(imports: Graph) -> None:
    assert circle(imports) == []


def test_parts_of_packages_import_in_no_circle(imports: Graph) -> None:
    circles = {
        package: names for package, parts in parts_of_packages(imports) if (names := circle(parts))
    }
    assert circles == {}


def test_circles_are_recognised() -> None:
    imports = {"p.a.x": {"p.b.y"}, "p.b.y": set(), "p.b.z": {"p.a.w"}, "p.a.w": set(), "p.a": set()}
    assert circle(imports) == []
    assert set(circle(dict(parts_of_packages(imports))["p"])) == {"a", "b"}
    assert set(circle({"a": {"b"}, "b": {"c"}, "c": {"a"}})) == {"a", "b", "c"}
