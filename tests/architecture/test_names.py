"""Names say what a value is; docstrings open with a noun or a verb. CONTRIBUTING.md has the rules."""

import ast
import re
from collections.abc import Iterator

from tests.architecture.test_layers import SOURCES

REFUSED = frozenset(
    re.findall(
        r"\w+",
        "one found own gone posed settled begun anew rough bend bent price prices vouch believed",
    )
)
QUESTION = re.compile(r"(What|Which|Where|How|Who|Whose|Why|When)\b")
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


def test_names_use_standard_terms() -> None:
    refused = [
        f"{path}:{line} {name}"
        for path, tree in SOURCES.items()
        for name, line in defined_names(tree)
        if name not in ALLOWED and words_of(name) & REFUSED
    ]
    assert refused == []


def test_refused_words_are_recognised() -> None:
    assert words_of("is_far_own") & REFUSED == {"own"}
    assert words_of("PosedProblem") & REFUSED == {"posed"}
    assert words_of("bone_ownership") & REFUSED == set()


def docstrings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and text of the docstrings of modules, classes, functions and attributes."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            value = statement.value if isinstance(statement, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield statement.lineno, value.value.strip()


def test_docstrings_open_with_a_noun_or_a_verb() -> None:
    questions = [
        f"{path}:{line} {text.splitlines()[0]}"
        for path, tree in SOURCES.items()
        for line, text in docstrings(tree)
        if QUESTION.match(text)
    ]
    assert questions == []


def test_questions_are_recognised() -> None:
    tree = ast.parse('class A:\n    """Which rows pass."""\n    x = 1\n    """Whichever."""\n')
    assert [bool(QUESTION.match(text)) for _, text in docstrings(tree)] == [True, False]
