"""The interactive console: unsaved changes, the history of the tutorial."""

import os
import re
import shutil
import signal
import time
from pathlib import Path

import pytest

from maplab_py.storage.map_saving import CARD_FILE
from tests.console import sample_plugin
from tests.docs.markdown import blocks
from tests.e2e.support import Console, run_program
from tests.support import data, waiting


@pytest.fixture
def with_plugin(tmp_path: Path) -> dict[str, str]:
    """Install the sample plugin for the child process: a distribution with an entry point."""
    distribution = tmp_path / "site" / "sample_plugin-1.0.dist-info"
    distribution.mkdir(parents=True)
    (distribution / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: sample-plugin\nVersion: 1.0\n"
    )
    (distribution / "entry_points.txt").write_text("[maplab_py.plugins]\nsample = sample_plugin\n")
    shutil.copy(sample_plugin.__file__, distribution.parent / "sample_plugin.py")
    paths = [str(distribution.parent), *filter(None, [os.environ.get("PYTHONPATH", "")])]
    return {"PYTHONPATH": os.pathsep.join(paths)}


def test_ctrl_d_with_unsaved_changes_asks(tmp_path: Path, with_plugin: dict[str, str]) -> None:
    console = Console(tmp_path, **with_plugin)
    console.wait_for_prompt()
    console.enter("create_new_map a; add_mission")
    console.wait_for_prompt("maplab <a>*:/$")
    console.type("\x04")
    console.wait_for_text("unsaved changes in a; leave without saving? [y/N]")
    console.enter("n")
    console.wait_for_prompt("maplab <a>*:/$")
    console.enter("undo")
    console.wait_for_prompt("maplab <a>:/$")
    console.enter("redo")
    console.wait_for_prompt("maplab <a>*:/$")
    console.enter("quit")
    console.wait_for(lambda _: console.last_line.endswith("leave without saving? [y/N]"))
    console.enter("y")
    assert console.status() == 0


def test_a_console_that_ignores_hang_ups_ends_with_its_terminal(
    tmp_path: Path, with_plugin: dict[str, str]
) -> None:
    """As under nohup: the question about unsaved changes has nobody to answer it."""
    console = Console(tmp_path, ignores_hang_ups=True, **with_plugin)
    console.wait_for_prompt()
    console.enter("create_new_map a; add_mission; !touch running; !sleep 1; echo words")
    assert waiting.wait_until((tmp_path / "running").exists)
    pid = console.child.pid
    os.close(console.child.child_fd)
    assert ended_with(pid) == 1
    (log,) = (tmp_path / "state").rglob("maplab.log")
    assert "the terminal was closed; unsaved changes in a" in log.read_text()


def ended_with(pid: int, seconds: float = 60.0) -> int:
    """Wait until a child process ends and return its status."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    raise AssertionError("the program runs on")


def test_a_script_fails_with_unsaved_changes(tmp_path: Path, with_plugin: dict[str, str]) -> None:
    script = "create_new_map a; add_mission"
    done = run_program(tmp_path, "-c", script, extra=with_plugin)
    assert done.returncode == 2
    assert "unsaved changes: a (kept in " in done.stderr
    assert run_program(tmp_path, "-c", script, "--discard", extra=with_plugin).returncode == 0


def test_a_strangers_command_runs_from_the_shell(
    tmp_path: Path, with_plugin: dict[str, str]
) -> None:
    done = run_program(tmp_path, "solve", "--ba-num-iterations", "3", extra=with_plugin)
    assert done.returncode == 0
    assert re.search(r"^iterations +3$", done.stdout, re.MULTILINE)
    done = run_program(tmp_path, "find_nothing", extra=with_plugin)
    assert done.returncode == 1
    done = run_program(
        tmp_path, "-c", "create_new_map a; fail_after_commit --how=program", extra=with_plugin
    )
    assert done.returncode == 1
    assert len([line for line in done.stderr.splitlines() if "ZeroDivisionError" in line]) == 1
    assert "maplab.log" in done.stderr
    assert "Traceback" not in done.stderr


def files_of(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != CARD_FILE  # the accuracy was measured in one session
    }


@pytest.mark.slow
def test_the_script_of_the_tutorial_makes_a_byte_identical_map(tmp_path: Path) -> None:
    parts = [text for _, text in blocks(data.REPOSITORY / "docs" / "tutorial.md", "maplab")]
    second = next(i for i, text in enumerate(parts) if "three_sessions" in text)
    (tmp_path / "tutorial.maplab").write_text(
        "\n".join(parts[second:]) + "\nundo\nredo\nhistory --as_script > steps.maplab\n"
        "save --map_folder=first --overwrite\n"
    )
    done = run_program(tmp_path, "run", "tutorial.maplab", seconds=600)
    assert done.returncode == 0, done.stderr
    (tmp_path / "save.maplab").write_text("save --map_folder=second\n")
    done = run_program(tmp_path, "run", "steps.maplab", "save.maplab", seconds=600)
    assert done.returncode == 0, done.stderr
    first, second = files_of(tmp_path / "first"), files_of(tmp_path / "second")
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
    steps = (tmp_path / "steps.maplab").read_text().splitlines()
    assert steps[0].startswith("load_merge_all_maps ")
    assert not any(line.startswith(("undo", "redo", "map_stats", "save")) for line in steps)
