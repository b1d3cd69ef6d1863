"""The server: order, publication, deletion, requests, and who may ask."""

import dataclasses
import json
import threading
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Message
from maplab_py.server import journal, merging
from maplab_py.server.client import NotRunning, ask, order
from maplab_py.server.options import IncrementalOptions, ServiceOptions
from maplab_py.server.server import MapServer
from maplab_py.server.service import Service
from maplab_py.server.status import status_without_server
from maplab_py.vimap import consistency, ids
from tests.server.support import ROBOTS, Servers, session, submaps
from tests.support.waiting import wait_until


class Running:
    """A server in a thread."""

    def __init__(self, server: MapServer) -> None:
        self.server = server
        self.thread = threading.Thread(target=server.run, daemon=True)
        self.thread.start()
        assert wait_until(server.spool.address.is_file)
        assert wait_until(lambda: _answers(server))

    def end(self) -> None:
        self.server.stop()
        self.thread.join(30.0)
        assert not self.thread.is_alive()


def _answers(server: MapServer) -> bool:
    try:
        return bool(ask(server.spool, "serve_status"))
    except NotRunning:
        return False


def test_submaps_of_two_robots_become_one_map(servers: Servers) -> None:
    for number in range(3):
        for robot in ROBOTS:
            servers.put(robot, number)
    server = servers.run()
    servers.check_whole(*ROBOTS)
    vi_map = servers.published()
    assert consistency.check_consistency(vi_map).errors == ()
    assert sorted(vi_map.missions.name) == list(ROBOTS)
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    assert known.tolist() == [True, False]
    assert server.status().merged == 6
    assert not list(servers.spool.accepted.iterdir())
    assert len(list(servers.spool.merged.iterdir())) == 6
    assert not servers.spool.address.exists()


def test_a_submap_that_adjoins_nothing_waits_for_its_neighbour(servers: Servers) -> None:
    servers.put("ant", 0)
    servers.put("ant", 2)
    server = servers.run()
    assert len(servers.published().vertices) == len(submaps("ant")[0].vertices)
    assert status_without_server(servers.spool).waiting == 1
    assert server.status().robots[0].submaps_waiting == 1
    servers.put("ant", 1)
    servers.run()
    servers.check_whole("ant")


def test_a_mission_may_grow_from_its_end(servers: Servers) -> None:
    for number in (2, 1, 0):
        servers.put("ant", number)
        servers.run()
    servers.check_whole("ant")


def test_the_map_is_optimised_jointly_after_every_nth_and_at_the_end(servers: Servers) -> None:
    servers.incremental = IncrementalOptions(full_optimization_every_nth=2)
    for number in range(3):
        servers.put("ant", number)
    server = servers.make()
    report = server.run()
    assert report.joint_optimizations == 2
    assert server.journal.since_joint == 0
    assert server.journal.radius > 0.0


def test_merged_submaps_are_published_before_a_joint_optimisation(
    servers: Servers, monkeypatch: pytest.MonkeyPatch
) -> None:
    servers.incremental = IncrementalOptions(full_optimization_every_nth=2)
    published: list[int] = []
    optimize_jointly = merging.Merger.optimize_jointly

    def noted(merger: merging.Merger, *, progress: Progress = SILENT) -> float:
        published.append(len(servers.published().vertices))
        return optimize_jointly(merger, progress=progress)

    monkeypatch.setattr(merging.Merger, "optimize_jointly", noted)
    for number in range(3):
        servers.put("ant", number)
    servers.run()
    times_ns = session("ant").vertices.timestamp_ns
    of_two = np.count_nonzero(times_ns <= submaps("ant")[1].vertices.timestamp_ns[-1])
    assert published == [of_two, len(times_ns)]


def test_without_saving_at_the_end_a_later_server_goes_on(
    servers: Servers, monkeypatch: pytest.MonkeyPatch
) -> None:
    servers.service = ServiceOptions(stop_when_idle_s=0.5, save_on_shutdown=False)
    for number in range(3):
        servers.put("ant", number)
    server = servers.make()
    monkeypatch.setattr("maplab_py.server.server.pause_s", lambda _: 1e9)
    report = server.run(lambda: len(server.steps) == 2)
    assert report.joint_optimizations == 0
    published = servers.published()
    assert len(published.vertices) == len(submaps("ant")[0].vertices)
    assert len(journal.read_journal(servers.spool.journal).merged) == 1
    servers.service = ServiceOptions(stop_when_idle_s=0.5)
    server = servers.run()
    servers.check_whole("ant")
    assert server.journal.since_joint == 0


def test_the_watcher_sees_every_published_map(servers: Servers) -> None:
    seen: list[int] = []
    server = MapServer(
        servers.spool,
        servers.options,
        incremental=servers.incremental,
        service=servers.service,
        watch=lambda vi_map: seen.append(len(vi_map.vertices)),
        shown_at="http://localhost:8080",
    )
    servers.put("ant", 0)
    server.run()
    assert "; its map is shown at http://localhost:8080\n" in servers.spool.log.read_text()
    assert seen[-1] == len(submaps("ant")[0].vertices)


def test_a_second_server_on_one_spool_is_refused(servers: Servers) -> None:
    servers.service = ServiceOptions()
    running = Running(servers.make())
    with pytest.raises(UserError, match=r"another server \(process \d+\) works on it"):
        servers.make().run()
    running.end()


def test_it_answers_on_loopback_and_stops_when_it_is_asked_to(servers: Servers) -> None:
    servers.service = ServiceOptions()
    running = Running(servers.make())
    servers.put("ant", 0)
    assert wait_until(lambda: ask(servers.spool, "serve_status")["merged"] == 1)
    status = ask(servers.spool, "serve_status")
    assert status["url"].startswith("http://127.0.0.1:")
    assert status["robots"][0]["robot"] == "ant"
    middle = int(submaps("ant")[0].vertices.timestamp_ns[3])
    answer = ask(
        servers.spool, "map_lookup", robot_name="ant", timestamp_ns=str(middle), p_S="0 0 0"
    )
    vi_map = servers.published()
    row = int(np.flatnonzero(vi_map.vertices.timestamp_ns == middle)[0])
    np.testing.assert_allclose(answer["p_G"], vi_map.T_G_I[row, 4:], atol=1e-9)
    with pytest.raises(UserError, match="robot_name=cow"):
        ask(servers.spool, "map_lookup", robot_name="cow", timestamp_ns="0")
    with pytest.raises(UserError, match="no resources of type"):
        ask(servers.spool, "get_dense_map_in_range", center_G="0 0 0", radius_m="1")
    order(servers.spool, "serve_stop")
    running.thread.join(30.0)
    assert not running.thread.is_alive()
    with pytest.raises(NotRunning, match="start one with maplab serve"):
        ask(servers.spool, "serve_status")


def test_a_deleted_mission_stays_deleted_and_its_submaps_are_refused(servers: Servers) -> None:
    servers.service = ServiceOptions()
    running = Running(servers.make())
    servers.put("ant", 0)
    servers.put("bee", 0)
    assert wait_until(lambda: ask(servers.spool, "serve_status")["merged"] == 2)
    mission = ids.to_hex(session("bee").missions.id[0])
    answer = order(servers.spool, "delete_mission", mission=mission)
    assert answer["missions"] == [mission]
    assert len(servers.published().missions) == 1
    servers.put("bee", 1)
    assert wait_until(servers.reasons)
    assert servers.reasons() == [f"bee/submap_1: mission {mission} was deleted"]
    order(servers.spool, "delete_all_robot_missions", robot_name="ant")
    assert not servers.map_folder.exists()
    with pytest.raises(UserError, match="no map yet"):
        order(servers.spool, "delete_all_robot_missions", robot_name="ant")
    running.end()
    servers.service = ServiceOptions(stop_when_idle_s=0.3)
    assert servers.run().status().vertices == 0


def test_the_folder_of_the_map_is_required_and_must_be_of_this_spool(servers: Servers) -> None:
    with pytest.raises(UserError, match="merged_map_folder is required"):
        servers.make(merged_map_folder="")
    servers.put("ant", 0)
    servers.run()
    other = Servers(servers.scratch / "other", pytest.MonkeyPatch())
    other.options = dataclasses.replace(other.options, merged_map_folder=str(servers.map_folder))
    with pytest.raises(UserError, match="did not come through"):
        other.run()
    assert len(servers.published().vertices) == len(submaps("ant")[0].vertices)


def test_backups_are_kept_beside_the_map(servers: Servers, monkeypatch: pytest.MonkeyPatch) -> None:
    servers.options = dataclasses.replace(servers.options, backup_interval_s=1)
    servers.service = ServiceOptions(stop_when_idle_s=1.5)
    servers.put("ant", 0)
    servers.run()
    backups = sorted(Path(f"{servers.map_folder}_backups").iterdir())
    assert len(backups) == 1
    assert (backups[0] / "vi_map").is_dir()


READS = {"state": lambda given: {"given": given}}


def stopped(given: dict[str, str]) -> Message:
    if not given:
        raise UserError("nothing given")
    return Message(f"stopped {given['name']}")


def sent(url: str, body: bytes | None = None, **headers: str) -> tuple[int, Any]:
    request = urllib.request.Request(url, data=body, headers=headers)
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(request, timeout=20.0) as answer:
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)


def test_loopback_needs_no_token_but_its_own_name(tmp_path: Path) -> None:
    file = tmp_path / "server.json"
    with Service(READS, {"stop": stopped}, address="127.0.0.1", port=0, file=file) as service:
        assert json.loads(file.read_text())["url"] == service.url
        assert file.stat().st_mode & 0o077 == 0
        assert sent(f"{service.url}/state?a=1") == (200, {"given": {"a": "1"}})
        assert sent(f"{service.url}/state", Host="evil.example")[0] == 403
        assert sent(f"{service.url}/stop")[0] == 404  # only POST changes something
        kind = {"Content-Type": "application/json"}
        assert sent(f"{service.url}/stop", b'{"name": "it"}', **kind)[1] == {"text": "stopped it"}
        assert sent(f"{service.url}/stop", b"{}", **kind) == (400, {"error": "nothing given"})
        missing = sent(f"{service.url}/stop", b'{"other": 1}', **kind)
        assert missing == (400, {"error": "the parameter name is missing"})
        for body in (b"[]", b"{", b"\xff"):
            assert sent(f"{service.url}/stop", body, **kind)[0] == 400
        form = {"Content-Type": "application/x-www-form-urlencoded"}
        assert sent(f"{service.url}/stop", b"name=it", **form)[0] == 400
    assert not file.exists()


def test_another_address_needs_the_token(tmp_path: Path) -> None:
    file = tmp_path / "server.json"
    with Service(READS, {}, address="0.0.0.0", port=0, file=file) as service:
        url = service.url.replace("0.0.0.0", "127.0.0.1")
        assert sent(f"{url}/state")[0] == 403
        assert sent(f"{url}/state", Authorization="Bearer wrong")[0] == 403
        token = json.loads(file.read_text())["token"]
        assert len(token) >= 32
        assert sent(f"{url}/state", Authorization=f"Bearer {token}")[0] == 200


def test_an_address_that_is_not_of_this_machine_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"--serve_address=192.0.2.1 .* cannot listen there"):
        Service(READS, {}, address="192.0.2.1", port=0, file=tmp_path / "server.json")
