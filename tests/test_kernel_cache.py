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
import subprocess, sys
from maplab_py import kernel_cache
folder = kernel_cache.cache_folder("kernels-1")
assert folder == kernel_cache.cache_folder("kernels-1")
line = "from maplab_py import kernel_cache; print(kernel_cache.cache_folder('kernels-1'))"
child = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True)
assert child.stderr == "", child.stderr
print(folder, child.stdout.strip(), sorted(path.name for path in folder.iterdir()))
"""

ASK_AS_NOBODY = f"""
import os
from maplab_py import kernel_cache
os.setuid({NOBODY})
folder = kernel_cache.cache_folder("kernels-1")
print(sorted(path.name for path in folder.iterdir()))
"""


def ask(code: str, folder: Path, *, temporary: Path) -> subprocess.CompletedProcess[str]:
    environment = {
        **os.environ,
        "MAPLAB_CACHE_DIR": str(folder),
        "PYTHONPATH": str(REPOSITORY),
        "TMPDIR": str(temporary),
    }
    return subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        cwd="/",
    )


def test_a_folder_of_ones_own_is_used(tmp_path: Path) -> None:
    done = ask(ASK, tmp_path / "cache", temporary=tmp_path)
    assert done.stdout.split()[:2] == [str(tmp_path / "cache" / "kernels-1")] * 2
    assert (tmp_path / "cache").stat().st_mode & 0o777 == 0o700
    assert done.stderr == ""


@pytest.mark.parametrize("mode", [0o777, 0o775, 0o757])
@pytest.mark.parametrize("inner", ["", "kernels-1"])
def test_a_folder_that_others_may_write_to_is_refused(
    tmp_path: Path, mode: int, inner: str
) -> None:
    (tmp_path / "cache" / "kernels-1").mkdir(parents=True, mode=0o755)
    (tmp_path / "cache" / inner).chmod(mode)
    done = ask(ASK, tmp_path / "cache", temporary=tmp_path)
    assert done.returncode != 0
    assert "can be written by other users" in done.stderr.splitlines()[-1]
    with pytest.raises(UserError, match="chmod go-w"):
        check_trusted(tmp_path / "cache" / inner, "MAPLAB_CACHE_DIR")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to somebody else")
def test_a_folder_of_somebody_else_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "cache"
    folder.mkdir(mode=0o755)
    os.chown(folder, NOBODY, NOBODY)
    with pytest.raises(UserError, match="belongs to another user"):
        check_trusted(folder, "MAPLAB_CACHE_DIR")


def test_the_console_refuses_in_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "cache"
    folder.mkdir()
    folder.chmod(0o777)
    done = run_program(tmp_path, "-c", "warmup", extra={"MAPLAB_CACHE_DIR": str(folder)})
    assert done.returncode == 2
    (error,) = [each for each in done.stderr.splitlines() if "error" in each]
    assert "name another folder by MAPLAB_CACHE_DIR" in error
    assert "Traceback" not in done.stderr


def test_a_folder_that_cannot_be_made_costs_one_run_and_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "temporary").mkdir()
    done = ask(ASK, tmp_path / "file" / "cache", temporary=tmp_path / "temporary")
    own, childs, files = done.stdout.split(maxsplit=2)
    assert own == childs
    assert Path(own).is_relative_to(tmp_path / "temporary")
    assert files.strip() == "[]"
    assert len(done.stderr.splitlines()) == 1
    assert "used in this run only" in done.stderr
    assert list((tmp_path / "temporary").iterdir()) == []


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as somebody else")
def test_what_a_read_only_folder_holds_is_used(tmp_path_factory: pytest.TempPathFactory) -> None:
    with tempfile.TemporaryDirectory(dir="/tmp") as name:  # pytest's own are closed to others
        home = Path(name)
        home.chmod(0o755)
        (home / "cache" / "kernels-1").mkdir(parents=True)
        (home / "cache" / "kernels-1" / "a.py").write_text("")
        (home / "temporary").mkdir()
        (home / "temporary").chmod(0o777)
        done = ask(ASK_AS_NOBODY, home / "cache", temporary=home / "temporary")
        assert done.stdout.strip() == "['a.py']", done.stderr
        assert "Permission denied" in done.stderr
        assert list((home / "temporary").iterdir()) == []
