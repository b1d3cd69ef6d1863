"""The program without a terminal: -c, scripts, standard input, JSON, statuses, start-up time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
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


def test_json_is_one_object_per_command(tmp_path: Path) -> None:
    done = run_program(tmp_path, "--json", "-c", "create_new_map a; list")
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["command"] for line in lines] == ["create_new_map", "list"]
    assert lines[1]["report"]["maps"][0]["map_key"] == "a"


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
    starts, peers = [], []
    for _ in range(4):
        starts.append(child_cpu_s(lambda: run_program(tmp_path, "-c", "help")))
        peers.append(libraries_start_s())
    assert min(starts) <= 1.25 * min(peers)


def test_an_error_is_an_object_with_json(tmp_path: Path) -> None:
    done = run_program(tmp_path, "--json", "-c", "list; map_stats")
    assert done.returncode == 2
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["status"] for line in lines] == [0, 2]
    assert "no map is selected" in lines[1]["error"]


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
