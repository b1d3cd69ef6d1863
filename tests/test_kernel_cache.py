"""The cache of compiled kernels: code of other users is refused, one that cannot be written is copied."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from maplab_py.errors import UserError
from maplab_py.kernel_cache import check_trusted
from tests.e2e.support import run_program
from tests.support.data import REPOSITORY

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
