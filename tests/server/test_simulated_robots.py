"""Recorded and simulated sessions that come into a spool."""

import dataclasses
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import MapError, UserError
from maplab_py.frontend import data_source, run_options
from maplab_py.frontend.mapping import Mapping
from maplab_py.interop.ply import PlyCloud, write_ply
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.server import service, submap_sources
from maplab_py.server.options import SubmapOutput
from maplab_py.storage.mission_names import named
from maplab_py.storage.native import find_maps, load_map, save_map
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.store import existing_files
from maplab_py.vimap import VIMap, consistency, merge
from tests.frontend.simulated import REST_FIRST, replayed
from tests.server.support import ROBOTS, Servers, session
from tests.support.submaps import append_submaps

_POINT_CLOUD = 16


def recordings(folder: Path) -> Path:
    """Save the sessions of two robots, each in a map of its own."""
    for robot in ROBOTS:
        save_map(session(robot), folder / robot)
    return folder


def played(spool: Path, maps: Path) -> list[str]:
    """Play maps, and return the folders of all submaps in the spool."""
    with Session() as console:
        report = console.run(
            "simulate_robots", spool=spool, maps_folder=maps, robots_submap_s=3.0, robots_rate=0.0
        )
    folders = find_maps(spool / "incoming")
    assert report.submaps == len(folders)
    return [path.relative_to(spool / "incoming").as_posix() for path in folders]


def test_a_server_merges_recordings_under_the_names_of_their_maps(servers: Servers) -> None:
    maps = recordings(servers.scratch / "maps")
    submaps = played(servers.spool.root, maps)
    assert submaps == [f"{robot}/submap_00{number}" for robot in ROBOTS for number in range(3)]
    servers.run()
    servers.check_whole(*ROBOTS)
    vi_map = servers.published()
    assert sorted(vi_map.missions.name) == list(ROBOTS)
    assert consistency.check_consistency(vi_map).errors == ()


def test_robots_are_named_after_their_missions_and_no_name_comes_twice(tmp_path: Path) -> None:
    both, _ = merge.merge_maps(*(session(robot) for robot in ROBOTS))
    save_map(named(both, ["a/b", "..ant"]), tmp_path / "ant")
    save_map(session("bee"), tmp_path / "below" / "ant")
    names = [*submap_sources.recorded_sessions(tmp_path)]
    assert names == ["a_b", "ant", "ant_2"]


def test_a_folder_without_maps_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="there is no map in it or below it"):
        submap_sources.recorded_sessions(tmp_path)


def with_a_cloud(vi_map: VIMap, scratch: Path) -> VIMap:
    """Return a session with a cloud of three points, which a frame in its second submap owns."""
    file = scratch / "cloud.ply"
    write_ply(PlyCloud(np.array([[0.0, 0.0, 0.1], [0.1, 0.0, 0.1], [0.0, 0.0, 50.0]])), file)
    new = NewResources(scratch, seed=vi_map.missions.id.tobytes())
    row = new.add(_POINT_CLOUD, file.read_bytes())
    file.unlink()
    return new.attached(vi_map, [row], [len(vi_map.frames) // 2])


def test_resources_of_recordings_come_along_and_the_server_finds_them(servers: Servers) -> None:
    maps = servers.scratch / "maps"
    for robot in ROBOTS:
        save_map(with_a_cloud(session(robot), servers.scratch), maps / robot)
    played(servers.spool.root, maps)
    servers.options = dataclasses.replace(servers.options, dense_map_resource_type=_POINT_CLOUD)
    servers.run()
    published = servers.published()
    assert published.metadata.external_resource_folders == ()
    assert len(existing_files(published, servers.map_folder)) == 2
    mission = published.vertices.mission[published.frames.vertex[published.resources.owner]]
    assert sorted(published.missions.name[mission]) == list(ROBOTS)
    known = int(
        np.flatnonzero(published.baseframes.is_known[published.missions.baseframe[mission]])[0]
    )
    center_G = published.T_G_I[published.frames.vertex[published.resources.owner[known]], 4:]
    points, clouds = service.dense_points_in_range(
        published, servers.map_folder, _POINT_CLOUD, center_G, 2.0
    )
    assert (len(points), clouds) == (2, 1)
    frames = published.baseframes
    unknown = published.replace(baseframes=frames.replace(is_known=np.zeros_like(frames.is_known)))
    with pytest.raises(UserError, match="all of missions that are not anchored yet"):
        service.dense_points_in_range(unknown, servers.map_folder, _POINT_CLOUD, center_G, 2.0)
    with pytest.raises(UserError, match="no resources of type"):
        service.dense_points_in_range(published, servers.map_folder, 8, center_G, 2.0)
    first, last = published.vertices.timestamp_ns[published.vertices.mission == 0][[0, -1]]
    with pytest.raises(UserError, match=f"then, but from {first} to {last} ns"):
        service.map_lookup(published, published.missions.name[0], last + 1, "", np.zeros(3))
    shutil.rmtree(maps / "ant" / "resources")
    with pytest.raises(MapError, match="the resource's file is missing"):
        submap_sources.timed_submaps(submap_sources.recorded_sessions(maps), 3.0)


def test_the_parts_of_a_recording_join_to_its_map(tmp_path: Path) -> None:
    walk, spool = tmp_path / "walk", tmp_path / "spool"
    save_map(replayed(REST_FIRST, 1)[0], walk)
    with Session() as session:
        session.run(
            "rovioli",
            datasource_folder=walk,
            submap_spool=spool,
            submap_interval_s=3.0,
            robot_name="ant",
        )
        whole = session.vi_map
        assert session.maps.unsaved == []  # the server has it
    folders = find_maps(spool / "incoming" / "ant")
    parts = [load_map(folder)[0] for folder in folders]
    assert len(parts) >= 3
    assert len({part.missions.id.tobytes() for part in parts}) == 1
    joined, report = append_submaps(parts)
    assert report.vertices_shared == len(parts) - 1
    assert report.landmarks_united > 0
    assert consistency.check_consistency(joined).errors == ()
    assert np.array_equal(joined.vertices.timestamp_ns, whole.vertices.timestamp_ns)
    assert len(joined.imu_samples) == len(whole.imu_samples)
    assert len(joined.keypoints) == len(whole.keypoints)
    ids = joined.vertices.id
    assert len(np.unique(ids, axis=0)) == len(ids)


def test_vertices_of_a_mission_that_was_given_up_are_missing(tmp_path: Path) -> None:
    writer = submap_sources.SubmapWriter(SubmapOutput(submap_spool=tmp_path / "spool"))
    builder = SimpleNamespace(missions=[range(5)])
    update = SimpleNamespace(state=object(), time_ns=0)
    writer.after_frame(update, SimpleNamespace(builder=builder))  # type: ignore[arg-type]
    assert writer.is_whole
    builder.missions.append(range(5))
    writer.after_frame(update, SimpleNamespace(builder=builder))  # type: ignore[arg-type]
    assert not writer.is_whole


def test_what_was_pushed_leaves_the_memory(tmp_path: Path) -> None:
    walk = tmp_path / "walk"
    save_map(replayed(REST_FIRST, 1)[0], walk)
    parts, left = [], []
    for forgets in (False, True):
        spool = tmp_path / f"spool_{forgets}"
        recording = data_source.open_source(walk, run_options.DataSourceOptions(), SourceOptions())
        writer = submap_sources.SubmapWriter(
            SubmapOutput(submap_spool=spool, submap_interval_s=3.0), forgets=forgets
        )
        mapping = Mapping(recording, run_options.RunOptions(), observer=writer)
        mapping.run()
        writer.finish(mapping)
        assert mapping.builder is not None
        left.append(len(mapping.builder.missions[0]))
        folders = find_maps(spool / "incoming" / "robot")
        parts.append([load_map(folder)[0].vertices for folder in folders])
    whole, rest = parts
    assert left[1] < left[0] / 2
    assert len(whole) == len(rest) >= 3
    for one, other in zip(whole, rest, strict=True):
        assert np.array_equal(one.timestamp_ns, other.timestamp_ns)
        assert np.array_equal(one.T_M_I, other.T_M_I)
