"""Machine code of kernels: found by content, in the wheel or in the user's cache."""

import importlib.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from maplab_py.compilation import TARGET, target_processor
from maplab_py.errors import UserError
from maplab_py.kernel_cache import check_trusted
from tests.e2e.support import run_program
from tests.support.data import REPOSITORY

SOURCES = {
    "values.py": """
from typing import NamedTuple
OFFSET = 1.0
class Line(NamedTuple):
    slope: float
    start: float
""",
    "inner.py": """
from maplab_py.compilation import compiled
@compiled()
def scaled(x):
    return 2.0 * x
""",
    "middle.py": """
from maplab_py.compilation import compiled
import inner
from values import OFFSET
@compiled()
def shifted(line):
    return inner.scaled(line.slope) + line.start + OFFSET
""",
    "outer.py": """
from maplab_py.compilation import compiled
from middle import shifted
@compiled()
def squared(line):
    return shifted(line) ** 2
""",
}
PROGRAM = """
import outer
from values import Line
print(outer.squared(Line(3.0, 0.0)), sum(outer.squared.stats.cache_hits.values()))
"""


def write(folder: Path, file: str = "", old: str = "", new: str = "") -> None:
    folder.mkdir(exist_ok=True)
    for name, text in SOURCES.items():
        (folder / name).write_text(text.replace(old, new) if name == file else text)


def run(folder: Path, program: str = PROGRAM, **variables: str) -> list[str]:
    """Return what a new process prints, by default a kernel's value and whether it was on disk."""
    path = os.pathsep.join([str(folder), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": path, "MAPLAB_CACHE_DIR": str(folder / "cache")}
    for name in ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"):  # the import above sets them
        environment.pop(name, None)
    command = [sys.executable, "-c", program]
    done = subprocess.run(
        command, env=environment | variables, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


CHANGES = [
    ("inner.py", "2.0", "10.0", "961.0"),
    ("inner.py", "2.0 * x", "2.0 + x", "36.0"),
    ("values.py", "1.0", "2.0", "64.0"),
    ("values.py", "slope: float\n    start: float", "start: float\n    slope: float", "16.0"),
    ("inner.py", "compiled()", "compiled(fastmath=True)", "49.0"),
]
"""What is changed in one file, and the value of the kernel then."""


def test_only_content_decides_whether_a_kernel_is_compiled_again(tmp_path: Path) -> None:
    folder = tmp_path / "sources"
    write(folder)
    assert run(folder) == ["49.0", "0"]
    for file, old, new, value in CHANGES:
        write(folder, file, old, new)
        assert run(folder) == [value, "0"], (file, new)
    write(folder, "outer.py", "@compiled", "\n# a comment in another line\n@compiled")
    os.utime(folder / "inner.py", (1e9, 1e9))
    assert run(folder.rename(tmp_path / "elsewhere")) == ["49.0", "1"]


def test_functions_of_kernels_can_be_called_from_python_too(tmp_path: Path) -> None:
    write(tmp_path)
    program = "import inner; print(inner.scaled(1.5))"
    assert run(tmp_path, f"{PROGRAM}{program}; {program}") == ["49.0", "0", "3.0", "3.0"]
    assert run(tmp_path, f"{program}{PROGRAM}") == ["3.0", "49.0", "1"]
    write(tmp_path, "outer.py", "** 2", "** 3")  # compiled with what was loaded with its code
    assert run(tmp_path, f"{program}{PROGRAM}") == ["3.0", "343.0", "0"]


def test_a_closure_is_never_kept(tmp_path: Path) -> None:
    (tmp_path / "outer.py").write_text(
        "from maplab_py.compilation import compiled\n"
        "def make(factor):\n    @compiled()\n    def scaled(x):\n        return factor * x\n"
        "    return scaled\n"
    )
    program = "import outer; print(outer.make(2.0)(3.0), outer.make(5.0)(3.0))"
    assert run(tmp_path, program) == run(tmp_path, program) == ["6.0", "15.0"]
    assert list((tmp_path / "cache").rglob("*.nbc")) == []


def test_the_processor_is_fixed_unless_the_user_says_otherwise(tmp_path: Path) -> None:
    write(tmp_path)
    program = PROGRAM + "import numba; print(numba.config.CPU_NAME, numba.config.CPU_FEATURES)"
    assert run(tmp_path, program) == ["49.0", "0", TARGET.rpartition("-numpy-")[2].split("-", 1)[1]]
    assert run(tmp_path, program, MAPLAB_NATIVE="1")[:3] == ["49.0", "0", "None"]
    assert run(tmp_path, MAPLAB_NATIVE="1") == ["49.0", "1"]
    assert run(tmp_path, program, NUMBA_CPU_NAME="nocona")[:3] == ["49.0", "0", "nocona"]


OLD = {"cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3"}
NEW = OLD | {"avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "avx512f"}


@pytest.mark.parametrize(
    ("machine", "features", "target"),
    [
        ("AMD64", NEW, "x86-64-v3"),
        ("x86_64", NEW - {"avx2"}, "x86-64-v2"),
        ("x86_64", NEW - {"ssse3"}, "x86-64"),
        ("aarch64", {"neon"}, "generic"),
    ],
)
def test_a_processor_gets_what_it_can_run(machine: str, features: set[str], target: str) -> None:
    assert target_processor(machine, features) == target


def test_the_wheels_kernels_come_first_and_one_line_says_why_not(tmp_path: Path) -> None:
    write(tmp_path)
    packaged, cache = tmp_path / "_kernels", tmp_path / "cache"
    program = f"""
from pathlib import Path
from maplab_py import compilation, kernel_cache
compilation.PACKAGED = Path({str(packaged)!r})
kernel_cache.tell_user = print
{PROGRAM}"""
    assert run(tmp_path, program) == ["49.0", "0"]
    cache.rename(packaged)
    assert run(tmp_path, program) == ["49.0", "1"]
    assert not cache.exists()
    (packaged / TARGET).rename(packaged / "code-of-another-numba")
    words = " ".join(run(tmp_path, program))
    assert words.endswith("49.0 0")
    assert words.count(f"the installed kernels are code-of-another-numba, not {TARGET}:") == 1


@pytest.fixture
def hook(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Return the hook of the build; instead of compiling it writes a file for each processor."""
    pytest.importorskip("hatchling", reason="needs the build system")
    spec = importlib.util.spec_from_file_location("hook", REPOSITORY / ".ci" / "kernels.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def compile_nothing(command: list[str], env: dict[str, str], check: bool) -> None:
        assert (command[1:], check) == (["-m", "maplab_py.warmup"], True)
        Path(env["MAPLAB_CACHE_DIR"], f"{env['NUMBA_CPU_NAME']}.nbc").write_text("")
        Path(env["MAPLAB_CACHE_DIR"], "left.lock").write_text("")

    monkeypatch.setattr(subprocess, "run", compile_nothing)
    requirements = ["numba>=0.60", "numpy>=1.26", "casadi>=3.6.5", "rich>=13.7", "numbalike"]
    metadata: Any = SimpleNamespace(core=SimpleNamespace(dependencies=requirements))
    return module.KernelHook(str(tmp_path), {}, None, metadata, str(tmp_path), "wheel")


@pytest.mark.parametrize(
    ("version", "processors", "needed"),
    [("standard", "x86-64-v3,x86-64-v2", 3), ("standard", "none", 0), ("editable", "", 3)],
)
def test_a_wheel_brings_the_kernels_for_the_named_processors(
    hook: Any, monkeypatch: pytest.MonkeyPatch, version: str, processors: str, needed: int
) -> None:
    monkeypatch.setenv("MAPLAB_WHEEL_KERNELS", processors)
    monkeypatch.setenv("MAPLAB_WHEEL_PLATFORM", "manylinux_2_28-x86.64")
    data: dict[str, Any] = {"force_include": {}}
    assert hook.dependencies() == ["numba>=0.60", "numpy>=1.26", "casadi>=3.6.5"][:needed]
    hook.initialize(version, data)
    if "-" in processors:
        inside = {f"maplab_py/_kernels/{name}.nbc" for name in processors.split(",")}
        assert set(data["force_include"].values()) == inside
        python = f"cp{sys.version_info[0]}{sys.version_info[1]}"
        assert data["tag"] == f"{python}-none-manylinux_2_28_x86_64"
    else:
        assert data == {"force_include": {}}
    hook.finalize(version, data, "")
    assert not any(map(os.path.exists, data["force_include"]))


NOBODY = 65534
ASK = """
import os, subprocess, sys
from maplab_py.kernel_cache import cache_folder
os.setuid({user})
folder = cache_folder("kernels-1")
line = "from maplab_py.kernel_cache import cache_folder; print(cache_folder('kernels-1'))"
if not {user}:  # another user may not run the interpreter
    child = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True)
    assert (child.stdout, child.stderr) == (f"{{folder}}\\n", "")
print(folder, *(path.name for path in folder.iterdir()))
"""


def ask(folder: Path, temporary: Path, user: int = 0) -> tuple[list[str], str]:
    """Return which folder a process and its child use, the files in it, and what was said."""
    environment = {
        **os.environ,
        "MAPLAB_CACHE_DIR": str(folder),
        "PYTHONPATH": str(REPOSITORY),
        "TMPDIR": str(temporary),
    }
    command = [sys.executable, "-c", ASK.format(user=user)]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False, cwd="/"
    )
    return done.stdout.split(), done.stderr


def test_a_folder_is_made_for_its_user_alone(tmp_path: Path) -> None:
    assert ask(tmp_path / "cache", tmp_path) == ([str(tmp_path / "cache" / "kernels-1")], "")
    assert (tmp_path / "cache").stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize(("mode", "inner"), [(0o777, ""), (0o775, "kernels-1"), (0o757, "")])
def test_a_folder_that_others_may_write_to_is_refused(
    tmp_path: Path, mode: int, inner: str
) -> None:
    (tmp_path / "cache" / "kernels-1").mkdir(parents=True, mode=0o755)
    (tmp_path / "cache" / inner).chmod(mode)
    assert "can be written by other users" in ask(tmp_path / "cache", tmp_path)[1].splitlines()[-1]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to somebody else")
def test_a_folder_of_somebody_else_is_refused(tmp_path: Path) -> None:
    os.chown(tmp_path, NOBODY, NOBODY)
    with pytest.raises(UserError, match="belongs to another user"):
        check_trusted(tmp_path)


def test_the_console_refuses_in_one_line(tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    done = run_program(tmp_path, "-c", "warmup", extra={"MAPLAB_CACHE_DIR": str(tmp_path)})
    assert done.returncode == 2
    (error,) = [each for each in done.stderr.splitlines() if "error" in each]
    assert "name another folder by MAPLAB_CACHE_DIR" in error
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as somebody else")
@pytest.mark.parametrize(("user", "reason"), [(0, "File exists"), (NOBODY, "Permission denied")])
def test_a_folder_that_cannot_be_written_is_copied_for_one_run(user: int, reason: str) -> None:
    with tempfile.TemporaryDirectory(dir="/tmp") as name:  # pytest's own are closed to others
        home, temporary = Path(name), Path(name, "temporary")
        home.chmod(0o755)
        temporary.mkdir()
        temporary.chmod(0o777)
        (home / "kernels-1").mkdir(mode=0o755)
        (home / "kernels-1" / "a.py").write_text("")
        missing = "" if user else "kernels-1/a.py/cache"
        (used, *copied), said = ask(home / missing, temporary, user)
        assert Path(used).is_relative_to(temporary)
        assert copied == (["a.py"] if user else [])
        assert len(said.splitlines()) == 1
        assert f"({reason}); kernels compiled now are used in this run only" in said
        assert list(temporary.iterdir()) == []
