"""Names say what a value is; CONTRIBUTING.md lists the words that do not."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.architecture.test_layers import SOURCES
from tests.support.data import REPOSITORY

REFUSED = frozenset(
    [
        "one",
        "found",
        "own",
        "gone",
        "posed",
        "settled",
        "begun",
        "anew",
        "rough",
        "bend",
        "bent",
        "price",
        "prices",
        "vouch",
        "believed",
    ]
)
ALLOWED = {
    "ONE",  # the number
    "MINUS_ONE",
    "one_to_one",  # the standard term of associations
    "loopclosure_one_mission",  # a command of C++ maplab
}


def defined_names(tree: ast.AST) -> Iterator[tuple[str, int]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr, node.lineno


def words_of(name: str) -> set[str]:
    return set(re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])([A-Z])", r"_\1", name).lower()))


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_names_use_standard_terms(path: Path) -> None:
    refused = [
        f"{path.name}:{line} {name}"
        for name, line in defined_names(ast.parse(path.read_text(encoding="utf-8")))
        if name not in ALLOWED and words_of(name) & REFUSED
    ]
    assert refused == []


def test_refused_words_are_recognised() -> None:
    assert words_of("is_far_own") & REFUSED == {"own"}
    assert words_of("PosedProblem") & REFUSED == {"posed"}
    assert words_of("bone_ownership") & REFUSED == set()
