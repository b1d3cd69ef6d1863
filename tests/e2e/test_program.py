"""The program without a terminal: scripts, streams, statuses, start-up time."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.support import PROGRAM, environment, run_program
from tests.support.machine import child_cpu_s, libraries_start_s


@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        (("-c", "help; plugins"), 0),
        (("-c", "nosuch"), 2),
        (("-c", "help --nosuch=1"), 2),
        (("-c", "map_stats"), 2),
        (("-c", "set ba_"), 2),
        (("help",), 0),
        (("help", "watch"), 0),
        (("watch", "--help"), 0),
        (("nosuch",), 2),
        (("--version",), 0),
        (("--help",), 0),
        (("--nosuch_flag=1", "-c", "help"), 2),
        (("run", "missing.maplab"), 2),
        (("batch", "missing.yaml"), 2),
        (("-c",), 2),
    ],
)
def test_exit_status(tmp_path: Path, arguments: tuple[str, ...], status: int) -> None:
    done = run_program(tmp_path, *arguments)
    assert done.returncode == status, done.stderr
    assert "Traceback" not in done.stderr
    assert "\x1b" not in done.stdout + done.stderr
    assert (status == 0) == bool(done.stdout)


def test_scripts_flag_files_and_standard_input(tmp_path: Path) -> None:
    (tmp_path / "a.maplab").write_text("# a script\nset --every=3\nflags\n")
    (tmp_path / "f").write_text("--repetitions=4\n")
    done = run_program(tmp_path, "run", "a.maplab", "--flagfile=f")
    assert done.returncode == 0, done.stderr
    assert "--every        3      set" in done.stdout
    assert "--repetitions  4      f:1" in done.stdout
    done = run_program(tmp_path, text="flags\nexit\nnosuch\n")
    assert (done.returncode, done.stdout) == (0, "all flags have their defaults\n")


def test_errors_and_tracebacks_go_to_the_log(tmp_path: Path) -> None:
    run_program(tmp_path, "nosuch")
    run_program(tmp_path, "-c", "list; other")
    log = (tmp_path / "state" / "maplab" / "maplab.log").read_text()
    assert "command: nosuch" in log
    assert "not started: column 7: unknown command 'other'" in log
    assert "Traceback" in log
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


def test_a_state_folder_that_cannot_be_written_is_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file where a folder is expected")
    done = run_program(tmp_path, "-c", "help")
    assert done.returncode == 0
    assert "no log file" in done.stderr


def test_a_full_disk_of_the_state_folder_is_no_obstacle(tmp_path: Path) -> None:
    done = subprocess.run(
        ["sh", "-c", 'ulimit -f 0; exec "$@"', "sh", *PROGRAM, "-c", "create_new_map a; list"],
        capture_output=True, text=True, cwd=tmp_path, env=environment(tmp_path), check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("warning: no more log") == 1
    assert "Traceback" not in done.stderr


def test_interrupt_ends_a_repetition_and_the_script_goes_on(tmp_path: Path) -> None:
    child = subprocess.Popen(
        [*PROGRAM, "-c", "create_new_map a; watch 'list' --every=30; list"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env=environment(tmp_path),
    )
    assert child.stdout is not None
    while "map key" not in child.stdout.readline():
        assert child.poll() is None
    os.kill(child.pid, signal.SIGINT)
    out, _ = child.communicate(timeout=30)
    assert child.returncode == 0
    assert "stopped after 1 run" in out


def test_only_the_plugins_that_the_environment_names_load(tmp_path: Path) -> None:
    done = run_program(tmp_path, "-c", "plugins", extra={"MAPLAB_PLUGINS": "missions"})
    assert done.returncode == 0
    assert "vi_map_basic" not in done.stdout
    done = run_program(tmp_path, "-c", "plugins", extra={"MAPLAB_PLUGINS": "nosuch"})
    assert done.returncode == 2


def test_start_up_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The console starts about as soon as a Python that imports numpy, scipy and a prompt."""
    monkeypatch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)  # installed, it is compiled
    run_program(tmp_path, "-c", "help")
    starts, refusals, peers = [], [], []
    for _ in range(4):
        starts.append(child_cpu_s(lambda: run_program(tmp_path, "-c", "help")))
        refusals.append(child_cpu_s(lambda: run_program(tmp_path, "-c", "load a; optvi --x; lod")))
        peers.append(libraries_start_s())
    assert min(starts) <= 1.25 * min(peers)
    assert min(refusals) <= 0.75 * min(peers)  # imports nothing but the plugins of its commands


def test_a_script_with_variables_comments_and_jobs(tmp_path: Path) -> None:
    (tmp_path / "s.maplab").write_text(
        "# where the result goes\nout=${RESULT}/x\ncreate_new_map a  # empty\n"
        "list &\njoin\ntranscript $out; list | grep -c a\n!cat $out > copy\n"
    )
    (tmp_path / "r").mkdir()
    done = run_program(tmp_path, "run", "s.maplab", extra={"RESULT": "r"})
    assert done.returncode == 0, done.stderr
    assert "[1] list" in done.stdout
    assert "> list" in (tmp_path / "copy").read_text()


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


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
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
