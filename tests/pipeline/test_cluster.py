"""Pipelines on Dask: a lost worker, Ctrl-C, a killed driver, a real scheduler on loopback."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from maplab_py.errors import UserError
from maplab_py.pipeline import PipelineOptions, Watcher, run_pipeline
from tests.e2e.support import PROGRAM, environment, run_program
from tests.pipeline import support
from tests.support.waiting import wait_until

pytest.importorskip("distributed")

FILE = """\
vi_map_folder_paths: [maps/*]
stages:
  - name: sessions
    each: maps
    commands: [load <CURRENT_VIMAP_FOLDER>, "!sleep $PAUSE_S", save --map_folder=<RESULT_FOLDER>]
  - name: merged
    all: sessions
    commands: [load_merge_map <CURRENT_VIMAP_FOLDER>, save --map_folder=<RESULT_FOLDER>]
"""


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """A Dask scheduler with two worker processes on loopback."""
    file = tmp_path / "scheduler.json"
    common = ["--scheduler-file", str(file)]
    commands = [
        ["scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", *common],
        *([["worker", "--nthreads", "1", "--no-nanny", "--no-dashboard", *common]] * 2),
    ]
    with (tmp_path / "dask.log").open("wb") as log:
        processes = [
            subprocess.Popen(
                [sys.executable, "-m", "dask", *words],
                stdout=log,
                stderr=log,
                env=environment(tmp_path, PAUSE_S="0"),
            )
            for words in commands
        ]
        try:
            assert wait_until(file.exists, 60.0)
            yield str(json.loads(file.read_text())["address"])
        finally:
            for process in processes:
                process.kill()
                process.wait()


def task_of(process: int) -> int:
    """Return the process of the task that a worker runs, 0 while there is none."""
    for child in support.child_processes(process):
        words = Path(f"/proc/{child}/cmdline").read_text().split("\0")
        if "maplab_py" in words:
            return child
    return 0


def busy_worker(driver: int) -> int:
    """Return a local worker that runs a task, 0 while there is none."""
    try:
        return next((child for child in support.child_processes(driver) if task_of(child)), 0)
    except (FileNotFoundError, ProcessLookupError):
        return 0


def started(
    folder: Path, pause_s: str, *, interrupts_ignored: bool = False
) -> subprocess.Popen[str]:
    in_background = ["/bin/sh", "-c", "trap '' INT; exec \"$@\"", "sh"] * interrupts_ignored
    return subprocess.Popen(
        [*in_background, *PROGRAM, "batch", "p.yaml", "--scheduler=local:2"],
        cwd=folder,
        env=environment(folder, PAUSE_S=pause_s),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def make_file(folder: Path, count: int) -> None:
    support.small_maps(folder / "maps", count)
    (folder / "p.yaml").write_text(FILE)


def test_a_lost_worker_costs_one_task(tmp_path: Path) -> None:
    maps = support.small_maps(tmp_path / "maps", 3)
    killed: list[int] = []

    def kill_one() -> None:
        wait_until(lambda: busy_worker(os.getpid()), 60.0)
        worker = busy_worker(os.getpid())
        task = task_of(worker)
        os.kill(worker, signal.SIGKILL)
        killed.append(task)

    killer = threading.Thread(target=kill_one)
    lines: list[str] = []
    killer.start()
    report = run_pipeline(
        support.pipeline(maps, support.sessions("!sleep 2"), support.MERGED),
        tmp_path / "r",
        PipelineOptions(scheduler="local:2"),
        watcher=Watcher(line=lines.append),
    )
    killer.join()
    assert report.failure == ""
    assert not support.is_alive(killed[0])
    assert len(support.starts(tmp_path / "r")) == 4 + 1
    assert "Dask's dashboard: http://127.0.0.1:" in lines[0]


@pytest.mark.slow
def test_a_killed_driver_leaves_nobody_and_resuming_does_the_rest(tmp_path: Path) -> None:
    make_file(tmp_path, 4)
    results = tmp_path / "p_results"
    child = started(tmp_path, "3")
    assert wait_until(lambda: list(results.glob("tasks/sessions/*.json")), 120.0)
    workers = support.child_processes(child.pid)
    tasks = [task_of(worker) for worker in workers if task_of(worker)]
    child.kill()
    child.wait()
    finished = len(list(results.glob("tasks/sessions/*.json")))
    assert 0 < finished < 4
    assert wait_until(lambda: not any(map(support.is_alive, [*workers, *tasks])), 60.0)
    words = ("batch", "p.yaml", "--resume", "--json")
    done = run_program(tmp_path, *words, extra={"PAUSE_S": "0"}, seconds=400)
    assert done.returncode == 0, done.stderr
    assert f'"done": {4 - finished}, "kept": {finished}' in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("is_ignored", [False, True], ids=["foreground", "background"])
def test_interrupt_stops_all_workers(tmp_path: Path, is_ignored: bool) -> None:
    make_file(tmp_path, 3)
    child = started(tmp_path, "60", interrupts_ignored=is_ignored)
    assert wait_until(lambda: busy_worker(child.pid), 60.0)
    workers = support.child_processes(child.pid)
    tasks = [task_of(worker) for worker in workers if task_of(worker)]
    os.killpg(child.pid, signal.SIGINT)
    _, errors = child.communicate(timeout=60)
    assert child.returncode == 130
    assert errors.splitlines()[-1] == (
        "error: batch: cancelled; finished tasks are kept (--resume runs the others)"
    )
    assert "Traceback" not in errors
    assert wait_until(lambda: not any(map(support.is_alive, [*workers, *tasks])), 30.0)


@pytest.mark.slow
def test_a_scheduler_on_loopback_gives_the_same_bytes(tmp_path: Path, scheduler: str) -> None:
    make_file(tmp_path, 2)
    folders = {}
    for name, kind in (("a", scheduler), ("b", "none"), ("c", "local:2")):
        flags = [f"--scheduler={kind}", f"--results_folder={name}"]
        words = ("batch", "p.yaml", *flags)
        done = run_program(tmp_path, *words, extra={"PAUSE_S": "0"}, seconds=400)
        assert done.returncode == 0, done.stderr
        folders[name] = support.contents(tmp_path / name)
    assert len(folders["a"]) > 3 * 5
    assert folders["a"] == folders["b"] == folders["c"]


def test_a_scheduler_that_does_not_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("maplab_py.pipeline.cluster._SECONDS_TO_CONNECT", 0.5)
    plan = support.pipeline(support.small_maps(tmp_path, 1), support.sessions())
    for address in ("tcp://127.0.0.1:1", "tcp://nowhere.invalid:8786"):
        with pytest.raises(UserError, match="no scheduler answers there; start one") as error:
            run_pipeline(plan, tmp_path / "r", PipelineOptions(scheduler=address))
        assert "\n" not in str(error.value)
    assert not (tmp_path / "r").exists()


def test_without_dask_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    plan = support.pipeline(support.small_maps(tmp_path, 1), support.sessions())
    with pytest.raises(UserError, match=r"pip install 'maplab-py\[cluster\]'"):
        run_pipeline(plan, tmp_path / "r", PipelineOptions(scheduler="local:1"))
