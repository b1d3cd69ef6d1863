"""Docstrings open with a noun or a verb, not with a question."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.architecture.test_layers import SOURCES
from tests.support.data import REPOSITORY

QUESTION = re.compile(r"(What|Which|Where|How|Who|Whose|Why|When)\b")


def docstrings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and text of the docstrings of modules, classes, functions and attributes."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            value = statement.value if isinstance(statement, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield statement.lineno, value.value.strip()


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_docstrings_open_with_a_noun_or_a_verb(path: Path) -> None:
    questions = [
        f"{path.name}:{line} {text.splitlines()[0]}"
        for line, text in docstrings(ast.parse(path.read_text(encoding="utf-8")))
        if QUESTION.match(text)
    ]
    assert questions == []


def test_questions_are_recognised() -> None:
    tree = ast.parse('class A:\n    """Which rows pass."""\n    x = 1\n    """Whichever."""\n')
    assert [bool(QUESTION.match(text)) for _, text in docstrings(tree)] == [True, False]
