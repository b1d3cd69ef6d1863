"""A server that ends at any point goes on where it was: every submap is in the map once."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from maplab_py.errors import UserError
from maplab_py.pipeline.messages import Outcome
from maplab_py.server import merging, publishing, status, worker
from maplab_py.server.journal import Journal, MergedSubmap, read_journal, write_journal
from maplab_py.server.spool import Spool
from tests.server.support import ROBOTS, Servers, copying, submaps
from tests.support.waiting import wait_until


@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize(
    ("owner", "name", "call"),
    [
        ("os", "rename", 1),  # accept, of the first
        ("os", "rename", 3),  # accept or finish
        (publishing.Publisher, "publish", 1),
        (publishing.Publisher, "publish", 2),
        ("maplab_py.server.server", "write_journal", 2),  # the first is that of the start
        (Spool, "finish", 1),
        (Spool, "finish", 2),
    ],
)
def test_it_goes_on_wherever_it_died(
    servers: Servers, owner: Any, name: str, call: int, after: bool
) -> None:
    for number in range(3):
        servers.put("ant", number)
    servers.run_until_killed(owner, name, call, after=after)
    servers.run()
    servers.check_whole("ant")
    journal = read_journal(servers.spool.journal)
    assert sorted(m.name for m in journal.merged) == ["submap_0", "submap_1", "submap_2"]
    assert len(list(servers.spool.merged.iterdir())) == 3
    assert not list(servers.spool.accepted.iterdir())
    assert servers.reasons() == []


@pytest.mark.parametrize(
    ("what", "times"), [("nothing", 0), ("flags", 1), ("damaged", 1), ("lost", 1)]
)
def test_what_a_worker_has_made_is_used_after_a_kill(
    servers: Servers, what: str, times: int
) -> None:
    servers.put("ant", 0)
    servers.run_until_killed(publishing.Publisher, "publish", 1, after=False)
    prepared = servers.spool.accepted / "000001" / "prepared"
    assert prepared.is_dir()
    if what == "flags":
        servers.options = dataclasses.replace(
            servers.options, remove_outliers_in_absolute_pose_constraints=False
        )
    elif what == "damaged":
        (prepared / "vi_map" / "vertices0").write_bytes(b"damaged")
    elif what == "lost":
        shutil.rmtree(prepared)
    calls = []

    def counted(order: worker.SubmapOrder, is_cancelled: Callable[[], bool]) -> Outcome:
        calls.append(order.title)
        return copying(order, is_cancelled)

    servers.work(counted)
    servers.run()
    assert len(calls) == times
    assert len(servers.published().vertices) == len(submaps("ant")[0].vertices)


def test_a_mission_that_was_being_deleted_is_deleted(servers: Servers) -> None:
    for robot in ROBOTS:
        servers.put(robot, 0)
    servers.run()
    journal = read_journal(servers.spool.journal)
    mission = next(m.stretches[0].mission for m in journal.merged if m.robot == "bee")
    write_journal(journal.without_missions({mission}), servers.spool.journal)
    servers.run()
    assert len(servers.published().missions) == 1


def test_a_backup_in_place_of_the_map_gets_what_it_lacks(servers: Servers) -> None:
    servers.put("ant", 0)
    servers.run()
    backup = servers.scratch / "backup"
    shutil.copytree(servers.map_folder, backup)
    for number in (1, 2):
        servers.put("ant", number)
        servers.run()
    shutil.rmtree(servers.map_folder)
    shutil.copytree(backup, servers.map_folder)
    servers.run()
    servers.check_whole("ant")


def test_a_lost_map_is_built_again(servers: Servers) -> None:
    for number in range(2):
        servers.put("ant", number)
    servers.run()
    vertices = len(servers.published().vertices)
    shutil.rmtree(servers.map_folder)
    servers.run()
    assert len(servers.published().vertices) == vertices


def test_a_lost_journal_is_written_again(servers: Servers) -> None:
    for number in range(2):
        servers.put("ant", number)
    servers.run()
    before = read_journal(servers.spool.journal)
    servers.spool.journal.unlink()
    servers.run()
    after = read_journal(servers.spool.journal)
    assert after.merged == before.merged
    assert after.robots == before.robots


def test_a_journal_comes_back_as_it_was_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    stretch = merging.Stretch("59f0", 1, 2)
    journal = Journal().with_merged(MergedSubmap(7, "ant", "s", "abc", (stretch,)))
    path = tmp_path / "journal.json"
    assert read_journal(path) == Journal()
    write_journal(journal, path)
    assert read_journal(path) == journal
    assert read_journal(path).robots == {"59f0": "ant"}
    path.write_text(path.read_text()[:-9])
    with pytest.raises(UserError, match=r"journal.json: is damaged; delete it"):
        read_journal(path)


def test_a_killed_process_is_followed_by_one_that_goes_on(
    servers: Servers, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Real processes: the server, its workers, and SIGKILL after the first merge."""
    monkeypatch.undo()  # workers are processes
    spool = servers.spool
    servers.put("ant", 0)
    first = start(servers, stop_when_idle_s=0)
    assert wait_until(lambda: status.status_without_server(spool).merged == 1, 120.0)
    servers.put("ant", 1)
    assert wait_until(lambda: not spool.arrivals(), 60.0)
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert len(servers.published().vertices) == len(submaps("ant")[0].vertices)
    second = start(servers, stop_when_idle_s=0.5)
    assert second.wait(120.0) == 0
    journal = read_journal(spool.journal)
    assert [m.name for m in journal.merged] == ["submap_0", "submap_1"]
    vertices = len(submaps("ant")[0].vertices) + len(submaps("ant")[1].vertices) - 1
    assert len(servers.published().vertices) == vertices


def start(servers: Servers, stop_when_idle_s: float) -> subprocess.Popen[bytes]:
    """Start a server as a program."""
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "maplab_py",
            "serve",
            f"--spool={servers.spool.root}",
            f"--maplab_server_merged_map_folder={servers.map_folder}",
            "--maplab_server_enable_visual_loop_closure=false",
            f"--serve_stop_when_idle_s={stop_when_idle_s}",
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "NUMBA_NUM_THREADS": "1"},
    )
