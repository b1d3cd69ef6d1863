"""What a server refuses, each with one line, while the merged map stays valid."""

import dataclasses
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.pipeline.messages import Ending, Outcome
from maplab_py.sensors import SensorSet
from maplab_py.server import publishing, worker
from maplab_py.server.spool import Arrival, Entry, Spool, push
from maplab_py.storage.native import save_map
from maplab_py.vimap import VIMap, edits
from tests.server.support import ROBOTS, Servers, copying, submaps


def refused(servers: Servers, robot: str, submap: VIMap) -> str:
    """Return why a submap is refused by a server that has ant's first one."""
    servers.put("ant", 0)
    servers.run()
    before = servers.published().vertices.id
    servers.put(robot, 1, submap, "bad")
    servers.run()
    assert np.array_equal(servers.published().vertices.id, before)
    (reason,) = servers.reasons()
    assert reason.startswith(f"{robot}/bad: ")
    servers.put("ant", 1)
    servers.run()
    assert len(servers.published().vertices) > len(before)
    return reason.removeprefix(f"{robot}/bad: ")


def test_two_robots_with_one_mission_id(servers: Servers) -> None:
    reason = refused(servers, "bee", submaps("ant")[1])
    assert "comes from robot ant already: give it an id of its own" in reason


def test_another_calibration(servers: Servers) -> None:
    submap = submaps("ant")[1]
    sensors = dict(submap.sensors.sensors)
    for name, sensor in sensors.items():
        if hasattr(sensor, "cameras"):
            camera = sensor.cameras[0]
            changed = dataclasses.replace(camera, intrinsics=camera.intrinsics + 1.0)
            sensors[name] = dataclasses.replace(sensor, cameras=(changed, *sensor.cameras[1:]))
    assert isinstance(submap.sensors, SensorSet)
    changed_set = dataclasses.replace(submap.sensors, sensors=sensors)
    assert "has another calibration" in refused(servers, "ant", submap.replace(sensors=changed_set))


def test_a_clock_that_jumps(servers: Servers) -> None:
    submap = submaps("ant")[1]
    samples = submap.imu_samples
    times_ns = samples.timestamp_ns.copy()
    inside = slice(int(submap.sample_start[1]) + 3, int(submap.sample_start[2]))
    times_ns[inside] += 5_000_000_000
    jumped = submap.replace(imu_samples=samples.replace(timestamp_ns=times_ns))
    reason = refused(servers, "ant", jumped)
    assert "clock jumps" in reason or "increase" in reason


def test_a_stretch_of_time_that_the_map_has_with_other_vertices(servers: Servers) -> None:
    servers.put("ant", 0)
    servers.run()
    other = edits.with_new_ids(submaps("ant")[0])
    same_mission = other.replace(missions=other.missions.replace(id=submaps("ant")[0].missions.id))
    servers.put("ant", 1, same_mission, "again")
    servers.run()
    assert servers.reasons() == []  # it adjoins nothing: it waits
    assert len(servers.published().vertices) == len(submaps("ant")[0].vertices)


def test_a_duplicate(servers: Servers) -> None:
    reason = refused(servers, "ant", submaps("ant")[0])
    assert reason == "is a duplicate of ant/submap_0"


def test_a_duplicate_that_was_saved_again(servers: Servers) -> None:
    submap = submaps("ant")[0]
    landmarks = submap.landmarks.replace(quality=np.zeros(len(submap.landmarks), np.int8) + 2)
    reason = refused(servers, "ant", submap.replace(landmarks=landmarks))
    assert reason == "brings no vertex that the map does not have"


def test_a_submap_that_is_half_copied_is_left_alone_until_nothing_comes_any_more(
    servers: Servers,
) -> None:
    servers.spool.make()
    whole = servers.scratch / "whole"
    save_map(submaps("ant")[0], whole)
    half = servers.spool.incoming / "ant" / "half"
    shutil.copytree(whole, half)
    vertices = next((half / "vi_map").glob("vertices*"))
    content = vertices.read_bytes()
    vertices.write_bytes(content[: len(content) // 2])
    (arrival,) = servers.spool.arrivals()
    assert not arrival.is_complete
    assert not arrival.reason
    vertices.write_bytes(content)
    assert servers.spool.arrivals()[0].is_complete
    vertices.write_bytes(content[: len(content) // 2])
    servers.run()
    (reason,) = servers.reasons()
    assert "ant/half: " in reason
    assert vertices.name in reason
    assert len(reason.splitlines()) == 1


def test_links_and_hidden_folders(servers: Servers) -> None:
    servers.spool.make()
    (servers.spool.incoming / "ant").mkdir()
    whole = servers.scratch / "whole"
    save_map(submaps("ant")[0], whole)
    (servers.spool.incoming / "ant" / "link").symlink_to(whole)
    shutil.copytree(whole, servers.spool.incoming / ".partial" / "x")
    (arrival,) = servers.spool.arrivals()
    assert arrival.reason == "is a symbolic link: put the folder itself there"


def test_a_full_disk_delays_the_map_and_loses_nothing(
    servers: Servers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("maplab_py.server.server._SECONDS_BETWEEN_RETRIES", 0.1)
    publish, failures = publishing.Publisher.publish, [1, 2]

    def full(publisher: publishing.Publisher, vi_map: VIMap, *, compress: bool) -> None:
        if failures:
            failures.pop()
            raise UserError("city: cannot be saved (No space left on device)")
        publish(publisher, vi_map, compress=compress)

    monkeypatch.setattr(publishing.Publisher, "publish", full)
    for number in range(3):
        servers.put("ant", number)
    server = servers.run()
    servers.check_whole("ant")
    assert server.status().problem == ""
    log = servers.spool.log.read_text()
    assert log.count("the map cannot be published: city: cannot be saved (No space") == 1


def test_a_full_disk_delays_what_comes(servers: Servers, monkeypatch: pytest.MonkeyPatch) -> None:
    accept, failures = Spool.accept, [1, 2]

    def full(spool: Spool, arrival: Arrival, number: int) -> Entry:
        if failures:
            failures.pop()
            raise UserError("entry.json: cannot be written (No space left on device)")
        return accept(spool, arrival, number)

    monkeypatch.setattr(Spool, "accept", full)
    servers.put("ant", 0)
    server = servers.run()
    assert len(servers.published().vertices) == len(submaps("ant")[0].vertices)
    assert server.status().problem == ""
    assert servers.reasons() == []
    assert servers.spool.log.read_text().count("cannot be taken") == 1


def test_a_full_disk_is_said_once_for_each_submap_that_it_stops(
    servers: Servers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("maplab_py.server.preparation._SECONDS_BETWEEN_RETRIES", 0.1)
    attempts: Counter[str] = Counter()

    def full(order: worker.SubmapOrder, is_cancelled: Callable[[], bool]) -> Outcome:
        attempts[order.title] += 1
        if attempts[order.title] <= 4:
            error = f".worker.{len(attempts)}: cannot be saved (No space left on device)"
            return Outcome(order.title, Ending.FAILED, error)
        return copying(order, is_cancelled)

    servers.work(full)
    for robot in ROBOTS:
        servers.put(robot, 0)
    servers.run()
    assert attempts == {"ant/submap_0": 5, "bee/submap_0": 5}
    log = servers.spool.log.read_text()
    for robot in ROBOTS:
        line = f"{robot}/submap_0: cannot be prepared (No space left on device)"
        assert log.count(line) == 1
    assert log.count("No space left") == 2
    assert servers.reasons() == []


def test_a_killed_worker_costs_an_attempt(servers: Servers) -> None:
    killed: list[str] = []

    def dying(order: worker.SubmapOrder, is_cancelled: Callable[[], bool]) -> Outcome:
        if not killed:
            killed.append(order.title)
            return Outcome(order.title, Ending.OVER_MEMORY, "was killed")
        return copying(order, is_cancelled)

    servers.work(dying)
    servers.put("ant", 0)
    servers.run()
    assert killed == ["ant/submap_0"]
    assert "ant/submap_0: was killed; it is tried again" in servers.spool.log.read_text()
    assert len(servers.published().vertices) == len(submaps("ant")[0].vertices)


@pytest.mark.parametrize(
    ("ending", "error"),
    [
        (Ending.FAILED, "optvi: ImportError: an error of the program"),
        (Ending.REFUSED, "prepared: cannot be saved (No space left on device)"),
    ],
)
def test_a_failure_that_is_not_the_submap_s_is_tried_again(
    servers: Servers, monkeypatch: pytest.MonkeyPatch, ending: Ending, error: str
) -> None:
    monkeypatch.setattr("maplab_py.server.preparation._SECONDS_BETWEEN_RETRIES", 0.1)
    failed: list[str] = []

    def failing(order: worker.SubmapOrder, is_cancelled: Callable[[], bool]) -> Outcome:
        if not failed:
            failed.append(order.title)
            return Outcome(order.title, ending, error)
        return copying(order, is_cancelled)

    servers.work(failing)
    servers.put("ant", 0)
    servers.run()
    assert failed == ["ant/submap_0"]
    assert servers.reasons() == []
    assert len(servers.published().vertices) == len(submaps("ant")[0].vertices)


def test_a_worker_that_dies_every_time_is_given_up(servers: Servers) -> None:
    servers.work(lambda order, _: Outcome(order.title, Ending.OVER_MEMORY, "was killed"))
    servers.put("ant", 0)
    servers.run()
    assert servers.reasons() == ["ant/submap_0: was killed, 3 times"]


@pytest.mark.parametrize("robot", ["", "a/b", ".hidden"])
def test_names_that_cannot_be_folders(servers: Servers, robot: str) -> None:
    with pytest.raises(UserError, match="--robot_name"):
        push(servers.spool, robot, Path("x"))


def test_push_refuses_what_is_no_map_and_what_is_there_already(
    servers: Servers, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match="is not a map folder"):
        push(servers.spool, "ant", tmp_path)
    servers.put("ant", 0)
    with pytest.raises(UserError, match="is there already"):
        servers.put("ant", 0)
    assert not list(servers.spool.partial.iterdir())
