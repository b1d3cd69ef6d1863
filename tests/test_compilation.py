"""Compiled kernels that call kernels of other files: an edit of those is seen."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

INNER = """
from maplab_py.compilation import compiled

@compiled()
def scaled(x):
    return {factor} * x
"""
MIDDLE = """
from maplab_py.compilation import compiled
from inner import scaled

@compiled()
def shifted(x):
    return scaled(x) + 1.0
"""
OUTER = """
from maplab_py.compilation import compiled
from middle import shifted

@compiled()
def squared(x):
    return shifted(x) ** 2
"""
PROGRAM = "import outer; print(outer.squared(3.0), sum(outer.squared.stats.cache_hits.values()))"


def run(folder: Path) -> tuple[float, int]:
    """Return the kernel's value in a new process, and how often the cache had its machine code."""
    path = os.pathsep.join([str(folder), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    value, hits = done.stdout.split()
    return float(value), int(hits)


def test_an_edit_two_files_away_compiles_a_kernel_again(tmp_path: Path) -> None:
    (tmp_path / "inner.py").write_text(INNER.format(factor="2.0"))
    (tmp_path / "middle.py").write_text(MIDDLE)
    (tmp_path / "outer.py").write_text(OUTER)
    assert run(tmp_path) == (49.0, 0)
    assert run(tmp_path) == (49.0, 1)
    (tmp_path / "inner.py").write_text(INNER.format(factor="10.0"))
    assert run(tmp_path) == (961.0, 0)
    assert run(tmp_path) == (961.0, 1)
