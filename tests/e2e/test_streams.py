"""Standard streams that are closed, broken or full: no traceback, an honest status."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.support import PROGRAM, environment

MAPLAB = f"{PROGRAM[0]} -m maplab_py"


def shell(home: Path, line: str) -> subprocess.CompletedProcess[str]:
    """Run a line by bash, $MAPLAB being the program."""
    return subprocess.run(
        ["bash", "-o", "pipefail", "-c", line.replace("$MAPLAB", MAPLAB)],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=home,
        env=environment(home),
        check=False,
    )


def combinations() -> list[str]:
    choices = [("", redirection) for redirection in ("<&-", ">&-", "2>&-")]
    return [" ".join(filter(None, chosen)) for chosen in itertools.product(*choices)]


@pytest.mark.parametrize("closed", combinations())
def test_closed_streams(tmp_path: Path, closed: str) -> None:
    done = shell(tmp_path, f'$MAPLAB -c "create_new_map a; save --map_folder=saved" {closed}')
    assert "Traceback" not in done.stdout + done.stderr
    assert "error" not in done.stderr
    assert done.returncode == 0
    assert (tmp_path / "saved" / "vi_map").is_dir()
    refused = shell(tmp_path, f'$MAPLAB -c "no_such_command" {closed}')
    assert refused.returncode == 2
    assert ("no_such_command" in refused.stderr) == ("2>&-" not in closed)
    assert "Traceback" not in refused.stderr


@pytest.mark.parametrize("line", ['-c "help; help; help; rename_map a"', "--help", "help"])
def test_a_reader_that_has_seen_enough_ends_the_program_quietly(tmp_path: Path, line: str) -> None:
    # the reader has closed the pipe before the program writes
    done = shell(tmp_path, f"$MAPLAB {line} | exec true; echo ${{PIPESTATUS[0]}}")
    assert done.stdout == "141\n"
    assert done.stderr == ""
    done = shell(tmp_path, f'$MAPLAB -c "{"help; " * 40}" | head -3')
    assert len(done.stdout.splitlines()) == 3
    assert done.stderr.count("error") == 0
    assert "Traceback" not in done.stderr


def test_a_pipe_of_the_console_may_be_closed_early(tmp_path: Path) -> None:
    done = shell(tmp_path, '$MAPLAB -c "help | true; help | head -1; map_keys_of_none"')
    assert done.returncode == 2
    assert "map_keys_of_none" in done.stderr
    assert "Broken" not in done.stderr


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="there is no /dev/full")
def test_a_full_device(tmp_path: Path) -> None:
    done = shell(tmp_path, '$MAPLAB -c "help" > /dev/full')
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "error: help: standard output cannot be written: No space left on device"
    )
    assert "Traceback" not in done.stderr
    assert "program" not in done.stderr
    assert shell(tmp_path, "$MAPLAB --version > /dev/full").returncode == 1
    done = shell(tmp_path, '$MAPLAB -c "help help" 2> /dev/full')
    assert done.returncode == 0
    assert "help" in done.stdout


def test_a_nul_character_and_names_that_are_too_long(tmp_path: Path) -> None:
    (tmp_path / "nul.maplab").write_bytes(b"load a\0b\n")
    (tmp_path / "long.maplab").write_text(f"load {'n' * 300}\n")
    (tmp_path / "saved.maplab").write_text(f"create_new_map a\nsave {'n' * 256}\n")
    (tmp_path / "written.maplab").write_text(f"load {'n/' * 3000}\n")
    for script in ("nul", "long", "saved", "written"):
        done = shell(tmp_path, f"$MAPLAB run {script}.maplab")
        assert done.returncode == 2, done.stderr
        (line,) = [each for each in done.stderr.splitlines() if each.startswith("error")]
        assert "an error of the program" not in line
    longest = "n" * 255
    done = shell(
        tmp_path, f'$MAPLAB -c "create_new_map a; save {longest}; delete_map --yes; load {longest}"'
    )
    assert done.returncode == 0, done.stderr
    done = shell(tmp_path, f"$MAPLAB run {'n' * 300}")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
