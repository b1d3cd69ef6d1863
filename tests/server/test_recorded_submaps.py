"""A recording whose map goes into a spool while it is read."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import FlagError
from maplab_py.frontend.data_source import open_source
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.run_options import DataSourceOptions, RunOptions
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.server.options import SubmapOutput
from maplab_py.server.submap_sources import SubmapWriter
from maplab_py.storage.native import find_maps, load_map, save_map
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.submaps import append_submaps
from tests.frontend.simulated import REST_FIRST, replayed


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
    assert check_consistency(joined).errors == ()
    assert np.array_equal(joined.vertices.timestamp_ns, whole.vertices.timestamp_ns)
    assert len(joined.imu_samples) == len(whole.imu_samples)
    assert len(joined.keypoints) == len(whole.keypoints)
    ids = joined.vertices.id
    assert len(np.unique(ids, axis=0)) == len(ids)


def test_the_interval_must_be_positive() -> None:
    with pytest.raises(FlagError, match="submap_interval_s=0"):
        SubmapOutput(submap_interval_s=0.0)


def test_vertices_of_a_mission_that_was_given_up_are_missing(tmp_path: Path) -> None:
    writer = SubmapWriter(SubmapOutput(submap_spool=tmp_path / "spool"))
    builder = SimpleNamespace(missions=1, count=lambda mission: 5)
    update = SimpleNamespace(state=object(), time_ns=0)
    writer.after_frame(update, SimpleNamespace(builder=builder))  # type: ignore[arg-type]
    assert writer.is_whole
    builder.missions = 2
    writer.after_frame(update, SimpleNamespace(builder=builder))  # type: ignore[arg-type]
    assert not writer.is_whole


def test_what_was_pushed_leaves_the_memory(tmp_path: Path) -> None:
    walk = tmp_path / "walk"
    save_map(replayed(REST_FIRST, 1)[0], walk)
    parts, left = [], []
    for forgets in (False, True):
        spool = tmp_path / f"spool_{forgets}"
        recording = open_source(walk, DataSourceOptions(), SourceOptions())
        writer = SubmapWriter(
            SubmapOutput(submap_spool=spool, submap_interval_s=3.0), forgets=forgets
        )
        mapping = Mapping(recording, RunOptions(), observer=writer)
        mapping.run()
        writer.finish(mapping)
        assert mapping.builder is not None
        left.append(mapping.builder.count(0))
        folders = find_maps(spool / "incoming" / "robot")
        parts.append([load_map(folder)[0].vertices for folder in folders])
    whole, rest = parts
    assert left[1] < left[0] / 2
    assert len(whole) == len(rest) >= 3
    for one, other in zip(whole, rest, strict=True):
        assert np.array_equal(one.timestamp_ns, other.timestamp_ns)
        assert np.array_equal(one.T_M_I, other.T_M_I)
