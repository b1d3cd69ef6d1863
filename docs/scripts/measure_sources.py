"""Measure the sources: files, lines, lines of code, share of imports, files with a single importer.

    python docs/scripts/measure_sources.py [FOLDER ...]

Lines of code are those without blank lines, comments and docstrings. With `--single-importers`, the files
that a single other file imports are listed with the size that both would have together.
"""

import argparse
import ast
import io
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

import grimp

REPOSITORY = Path(__file__).resolve().parents[2]
ROOTS = {"maplab_py": REPOSITORY, "maplab_plugins": REPOSITORY / "plugins"}
_NO_CODE = (
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
)


def code_lines(text: str) -> set[int]:
    """Return the numbers of the lines that hold code."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant | ast.JoinedStr):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def import_lines(text: str) -> set[int]:
    """Return the numbers of the lines of import statements."""
    return {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }


def measure(paths: list[Path]) -> tuple[int, int, int, int]:
    """Return files, lines, lines of code and lines of imports."""
    texts = [path.read_text(encoding="utf-8") for path in paths]
    return (
        len(texts),
        sum(len(text.splitlines()) for text in texts),
        sum(len(code_lines(text)) for text in texts),
        sum(len(import_lines(text)) for text in texts),
    )


def single_importers() -> Iterator[tuple[Path, Path, int]]:
    """Yield the files that one other file imports, that file, and the lines of both together."""
    graph = grimp.build_graph(*ROOTS, cache_dir=None)
    for module in sorted(graph.modules):
        importers = graph.find_modules_that_directly_import(module)
        path = _path(module)
        if len(importers) == 1 and path.name != "__init__.py":
            user = _path(next(iter(importers)))
            together = sum(len(p.read_text(encoding="utf-8").splitlines()) for p in (path, user))
            yield path, user, together


def _path(module: str) -> Path:
    stem = ROOTS[module.partition(".")[0]].joinpath(*module.split("."))
    return stem / "__init__.py" if stem.is_dir() else stem.with_suffix(".py")


def main() -> None:
    """Print a table of the rooms, or of the files with a single importer."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="*", default=["maplab_py", "plugins"])
    parser.add_argument("--single-importers", action="store_true")
    arguments = parser.parse_args()
    folders = [REPOSITORY / folder for folder in arguments.folders]
    if arguments.single_importers:
        for path, user, together in single_importers():
            if any(folder in path.parents for folder in folders):
                names = " -> ".join(str(p.relative_to(REPOSITORY)) for p in (path, user))
                sys.stdout.write(f"{together:5} {names}\n")
        return
    sys.stdout.write(f"{'files':>6} {'lines':>7} {'code':>7} {'imports':>8}  room\n")
    for folder in folders:
        paths = [p for p in sorted(folder.rglob("*.py")) if not p.name.endswith("_pb2.py")]
        files, lines, code, imports = measure(paths)
        share = 100.0 * imports / max(code, 1)
        room = folder.relative_to(REPOSITORY)
        sys.stdout.write(f"{files:6} {lines:7} {code:7} {imports:5} {share:4.1f}%  {room}\n")


if __name__ == "__main__":
    main()
