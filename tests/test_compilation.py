"""Machine code of kernels is found by content: of all sources that matter, not by times and paths."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from maplab_py.compilation import BUILT_WITH, built_with, target_processor

INNER = """
from typing import NamedTuple
from maplab_py.compilation import compiled

class Line(NamedTuple):
    slope: float
    start: float

@compiled()
def scaled(x):
    return {factor} * x
"""
MIDDLE = """
from maplab_py.compilation import compiled
from inner import scaled
OFFSET = {offset}

@compiled()
def shifted(x):
    return scaled(x) + OFFSET
"""
OUTER = """
from maplab_py.compilation import compiled
from middle import shifted

@compiled({settings})
def squared(x):
    return shifted(x) ** 2
"""
PROGRAM = """
import outer
value = outer.squared(3.0)
print(value, sum(outer.squared.stats.cache_hits.values()))
"""


def write(folder: Path, factor: str = "2.0", offset: str = "1.0", settings: str = "") -> None:
    folder.mkdir(exist_ok=True)
    (folder / "inner.py").write_text(INNER.format(factor=factor))
    (folder / "middle.py").write_text(MIDDLE.format(offset=offset))
    (folder / "outer.py").write_text(OUTER.format(settings=settings))


def run(folder: Path, cache: Path, program: str = PROGRAM, **extra: str) -> list[str]:
    """Return what a new process prints, by default a kernel's value and whether it was on disk."""
    path = os.pathsep.join([str(folder), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": path, "MAPLAB_CACHE_DIR": str(cache), **extra}
    for name in ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"):  # imports of other tests set them
        if name not in extra:
            environment.pop(name, None)
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_only_content_decides_whether_a_kernel_is_compiled_again(tmp_path: Path) -> None:
    sources, cache = tmp_path / "sources", tmp_path / "cache"
    write(sources)
    assert run(sources, cache) == ["49.0", "0"]
    os.utime(sources / "inner.py", (1e9, 1e9))
    shutil.copytree(sources, tmp_path / "elsewhere")
    assert run(tmp_path / "elsewhere", cache) == ["49.0", "1"]
    for change, value in (
        ({"factor": "10.0"}, "961.0"),
        ({"offset": "2.0"}, "64.0"),
        ({"settings": "fastmath=True"}, "49.0"),
    ):
        write(sources, **change)
        assert run(sources, cache) == [value, "0"]
        assert run(sources, cache) == [value, "1"]
    write(sources)  # what was compiled for the first content is still there
    assert run(sources, cache) == ["49.0", "1"]


def test_constants_and_fields_from_other_modules_count(tmp_path: Path) -> None:
    def write_pair(offset: str, fields: str) -> None:
        (tmp_path / "values.py").write_text(
            f"from typing import NamedTuple\nOFFSET = {offset}\n"
            f"class Line(NamedTuple):\n    {fields}\n"
        )

    (tmp_path / "outer.py").write_text(
        "from maplab_py.compilation import compiled\nfrom values import OFFSET, Line\n\n"
        "@compiled()\ndef squared(line):\n    return (10.0 * line.slope + line.start + OFFSET)\n"
    )
    program = PROGRAM.replace("(3.0)", "(outer.Line(1.0, 2.0))")
    for offset, fields, value in (
        ("0.0", "slope: float; start: float", "12.0"),
        ("5.0", "slope: float; start: float", "17.0"),
        ("0.0", "start: float; slope: float", "21.0"),
    ):
        write_pair(offset, fields)
        assert run(tmp_path, tmp_path / "cache", program) == [value, "0"]
        assert run(tmp_path, tmp_path / "cache", program) == [value, "1"]


def test_a_closure_is_never_kept(tmp_path: Path) -> None:
    (tmp_path / "outer.py").write_text(
        "from maplab_py.compilation import compiled\nimport sys\n"
        "def make(factor):\n    @compiled()\n    def scaled(x):\n        return factor * x\n"
        "    return scaled\nfirst, squared = make(2.0), make(5.0)\nfirst(3.0)\n"
    )
    assert run(tmp_path, tmp_path / "cache") == ["15.0", "0"]
    assert run(tmp_path, tmp_path / "cache") == ["15.0", "0"]


TARGET = "import outer, numba; print(numba.config.CPU_NAME, numba.config.CPU_FEATURES or 'no')"


def test_the_processor_is_fixed_unless_the_user_says_otherwise(tmp_path: Path) -> None:
    write(tmp_path)
    cache = tmp_path / "cache"
    name, features = run(tmp_path, cache, TARGET)
    assert (name == "generic" or name.startswith("x86-64"), features) == (True, "no")
    assert run(tmp_path, cache, TARGET, MAPLAB_NATIVE="1")[0] == "None"
    assert run(tmp_path, cache, TARGET, NUMBA_CPU_NAME="nocona", NUMBA_CPU_FEATURES="") == [
        "nocona",
        "no",
    ]
    assert run(tmp_path, cache) == ["49.0", "0"]
    assert run(tmp_path, cache, MAPLAB_NATIVE="1") == ["49.0", "0"]
    assert run(tmp_path, cache, MAPLAB_NATIVE="1") == ["49.0", "1"]


OLD = {"cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3"}
NEW = OLD | {"avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "avx512f"}


@pytest.mark.parametrize(
    ("machine", "features", "target"),
    [
        ("x86_64", NEW, "x86-64-v3"),
        ("AMD64", NEW, "x86-64-v3"),
        ("x86_64", NEW - {"avx2"}, "x86-64-v2"),
        ("x86_64", NEW - {"ssse3"}, "x86-64"),
        ("x86_64", set(), "x86-64"),
        ("aarch64", {"neon"}, "generic"),
    ],
)
def test_a_processor_gets_what_it_can_run(machine: str, features: set[str], target: str) -> None:
    assert target_processor(machine, features) == target


def test_no_writable_cache_means_compiling_again(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "file").write_text("")
    assert run(tmp_path, tmp_path / "file" / "cache") == ["49.0", "0"]
    assert run(tmp_path, tmp_path / "file" / "cache") == ["49.0", "0"]


PACKAGED = """
from pathlib import Path
from maplab_py import compilation, kernel_cache
compilation.PACKAGED = Path({folder!r})
kernel_cache.tell_user = print
import maplab_py_outer
value = maplab_py_outer.squared(3.0)
print(value, sum(maplab_py_outer.squared.stats.cache_hits.values()))
"""


def test_kernels_of_the_package_come_first_and_one_line_says_why_they_do_not_fit(
    tmp_path: Path,
) -> None:
    write(tmp_path)
    (tmp_path / "outer.py").rename(tmp_path / "maplab_py_outer.py")
    packaged, cache = tmp_path / "_kernels", tmp_path / "cache"
    program = PACKAGED.format(folder=str(packaged))
    assert run(tmp_path, packaged, program) == ["49.0", "0"]  # as the build of a wheel compiles
    described = tmp_path / "_kernels" / BUILT_WITH
    described.write_text(json.dumps({**built_with(), "processor": "x86-64-v2, x86-64-v3, generic"}))
    assert run(tmp_path, cache, program) == ["49.0", "1"]
    assert list((cache / "code").iterdir()) == []
    shutil.rmtree(packaged / "code")
    assert run(tmp_path, cache, program)[-2:] == ["49.0", "0"]  # silent, as no reason is known
    described.write_text(json.dumps({**built_with(), "numba": "0.1", "processor": "x86-64-v9"}))
    shutil.rmtree(cache)
    words = " ".join(run(tmp_path, cache, program))
    assert words.count("the installed kernels were compiled with") == 1
    assert "numba 0.1, not" in words
    assert "processor x86-64-v9, not" in words
    assert words.endswith("49.0 0")
