"""pose_to_bag: the bag's messages byte by byte, and the poses of the map at the asked rate."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.bags.options import PoseToBagOptions
from maplab_py.interop.bags.poses import add_poses_to_bag, pose_times
from maplab_py.interop.recordings.bag_files import opened_bag
from maplab_py.interop.recordings.bag_layouts import pose_messages
from maplab_py.interop.recordings.bag_writing import (
    BagFormat,
    bag_files,
    messages_of_topic,
)
from maplab_py.interop.recordings.bag_writing import write_bag as write_messages_as_bag
from maplab_py.interop.vertex_states import poses_at
from maplab_py.vimap import VIMap
from tests.interop.bags.small_bags import FORMATS, messages_of, named, pose_of
from tests.interop.recordings.written import make_content, write_bag
from tests.interop.small_map import PERIOD_NS, VERTICES, make_map

pytest.importorskip("rosbags")

FIRST = np.array([0])
VERTEX_RATE = PoseToBagOptions(interpolate_to_frequency_hz=1e-3)


def recorded(folder: Path, kind: BagFormat) -> Path:
    version = 2 if kind.is_ros_2 else 1
    return write_bag(make_content(), named(folder, kind, "in"), version=version, storage=kind.value)


def raw(path: Path) -> list[tuple[str, int, bytes]]:
    with opened_bag(path) as reader:
        return [(c.topic, time_ns, data) for c, time_ns, data in reader.messages()]


@pytest.mark.parametrize("kind", FORMATS)
def test_messages_stay_and_poses_come(tmp_path: Path, kind: BagFormat) -> None:
    vi_map, source = make_map(), recorded(tmp_path, kind)
    target = named(tmp_path, kind)
    report = add_poses_to_bag(vi_map, source, target, VERTEX_RATE, missions=FIRST)
    before = raw(source)
    after = raw(target)
    assert [entry for entry in after if not entry[0].startswith(("/T_", "/tf"))] == before
    assert [time for _, time, _ in after] == sorted(time for _, time, _ in after)
    assert report.copied_messages == len(before)
    assert report.messages == len(after) == len(before) + 4 * VERTICES
    topics = messages_of(target)
    stamps = vi_map.vertices.timestamp_ns[:VERTICES].tolist()
    for name, T, frames in (
        ("/T_M_I", vi_map.vertices.T_M_I[:VERTICES], ("mission", "imu")),
        ("/T_G_I", vi_map.T_G_I[:VERTICES], ("map", "imu")),
        ("/T_G_M", np.tile(vi_map.T_G_M[0], (VERTICES, 1)), ("map", "mission")),
    ):
        assert [time for time, _ in topics[name]] == stamps
        poses = [pose_of(message.transform) for _, message in topics[name]]
        np.testing.assert_array_equal(poses, T)
        heads = {(m.header.frame_id, m.child_frame_id) for _, m in topics[name]}
        assert heads == {frames}
    tree = [message.transforms for _, message in topics["/tf"]]
    assert [len(transforms) for transforms in tree] == [2] * VERTICES
    assert [t.child_frame_id for t in tree[0]] == ["mission", "imu"]
    np.testing.assert_array_equal(
        [pose_of(transforms[1].transform) for transforms in tree], vi_map.vertices.T_M_I[:VERTICES]
    )


def test_several_missions_are_numbered_by_time(tmp_path: Path) -> None:
    vi_map, source = make_map(), recorded(tmp_path, BagFormat.ROS1)
    options = PoseToBagOptions(base_frame="body", odom_frame="odom", world_frame="world")
    add_poses_to_bag(vi_map, source, tmp_path / "out.bag", options)
    topics = messages_of(tmp_path / "out.bag")
    for number in (0, 1):
        message = topics[f"/T_M_I_{number}"][0][1]
        assert (message.header.frame_id, message.child_frame_id) == (
            f"odom_{number}",
            f"body_{number}",
        )
        assert topics[f"/T_G_I_{number}"][0][1].header.frame_id == "world"
        assert topics[f"/T_M_I_{number}"][0][0] == vi_map.vertices.timestamp_ns[number * VERTICES]


def test_poses_between_vertices(tmp_path: Path) -> None:
    vi_map, source = make_map(), recorded(tmp_path, BagFormat.MCAP)
    options = PoseToBagOptions(add_tf=False, interpolate_to_frequency_hz=8.0)
    add_poses_to_bag(vi_map, source, tmp_path / "out", options, missions=FIRST)
    topics = messages_of(tmp_path / "out")
    assert "/tf" not in topics
    times_ns = np.array([time for time, _ in topics["/T_M_I"]])
    assert len(times_ns) == 4 * (VERTICES - 1) + 1
    assert set(np.diff(times_ns)) == {PERIOD_NS // 4}
    T_M_I = np.array([pose_of(message.transform) for _, message in topics["/T_M_I"]])
    np.testing.assert_array_equal(T_M_I, poses_at(vi_map, 0, times_ns))
    t = (times_ns - times_ns[0]) * 1e-9
    np.testing.assert_allclose(T_M_I[:, 6], 0.1 * t**2, atol=1e-12)  # cubic, not linear
    T_G_I = np.array([pose_of(message.transform) for _, message in topics["/T_G_I"]])
    np.testing.assert_array_equal(T_G_I, se3.compose(vi_map.T_G_M[0], T_M_I))


@given(
    gaps=st.lists(st.integers(1, 300), min_size=1, max_size=8),
    period=st.integers(1, 100),
)
def test_pose_times(gaps: list[int], period: int) -> None:
    stamps = np.cumsum([5, *gaps])
    expected = {
        int(time) for a, b in pairwise(stamps.tolist()) for time in [*range(a, b, period), b]
    }
    assert pose_times(stamps, period).tolist() == sorted(expected)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_bag_with_poses_gets_further_ones_or_loses_them(tmp_path: Path, kind: BagFormat) -> None:
    vi_map, source = make_map(), recorded(tmp_path, kind)
    once, twice, dropped = (named(tmp_path, kind, name) for name in ("once", "twice", "dropped"))
    add_poses_to_bag(vi_map, source, once, VERTEX_RATE, missions=FIRST)
    add_poses_to_bag(vi_map, once, twice, VERTEX_RATE, missions=FIRST)
    assert len(messages_of(twice)["/tf"]) == 2 * VERTICES
    assert len(messages_of(twice)["/T_G_I"]) == 2 * VERTICES
    options = PoseToBagOptions(add_tf=False, add_transform_stamped=False, drop_tf=True)
    add_poses_to_bag(vi_map, once, dropped, options, missions=FIRST)
    assert set(messages_of(once)) - set(messages_of(dropped)) == {"/tf"}


@pytest.mark.parametrize("kind", [BagFormat.SQLITE3, BagFormat.MCAP])
def test_a_single_file_of_a_ros_2_bag(tmp_path: Path, kind: BagFormat) -> None:
    (file, _) = bag_files(recorded(tmp_path, kind), kind)
    report = add_poses_to_bag(make_map(), file, tmp_path / "out", VERTEX_RATE, missions=FIRST)
    assert report.format == kind.value
    assert len(messages_of(tmp_path / "out")["/T_G_I"]) == VERTICES


def test_wrong_bags_are_refused(tmp_path: Path) -> None:
    vi_map, source = make_map(), recorded(tmp_path, BagFormat.ROS1)
    target = tmp_path / "out.bag"

    def refused(problem: str, kind: type[Exception] = UserError, **paths: Path) -> None:
        with pytest.raises(kind, match=problem) as error:
            add_poses_to_bag(vi_map, **({"source": source, "target": target} | paths))
        assert "\n" not in str(error.value)
        assert not target.exists()

    refused("input_bag=.*no.bag does not exist", source=tmp_path / "no.bag")
    (tmp_path / "text.txt").write_text("hello")
    refused("text.txt is no bag", source=tmp_path / "text.txt")
    refused("is the input: name another bag", target=source)
    refused("name it so, or give another", target=tmp_path / "folder")
    cut = tmp_path / "cut.bag"
    cut.write_bytes(source.read_bytes()[:-2000])
    refused("cut.bag: the bag cannot be read", MapError, source=cut)
    unindexed = tmp_path / "unindexed.bag"
    data = source.read_bytes()
    at = data.index(b"index_pos=") + len(b"index_pos=")
    unindexed.write_bytes(data[:at] + bytes(8) + data[at + 8 :])
    refused("unindexed.bag: the bag cannot be read .*reindex", MapError, source=unindexed)
    wrong = tmp_path / "wrong.bag"
    times_ns = np.array([10, 20])
    rows = pose_messages(times_ns, se3.identity(2), "map", is_ros_2=False)
    kind = "geometry_msgs/msg/PoseStamped"
    write_messages_as_bag(wrong, BagFormat.ROS1, messages_of_topic(times_ns, "/tf", kind, rows))
    refused("/tf has messages of type .*drop_tf", MapError, source=wrong)
    with pytest.raises(UserError, match="no vertices"):
        add_poses_to_bag(VIMap(), source, target)
    target.write_bytes(b"kept")
    with pytest.raises(UserError, match="exists already: give --overwrite"):
        add_poses_to_bag(vi_map, source, target)
    assert target.read_bytes() == b"kept"
    add_poses_to_bag(vi_map, source, target, overwrite=True)
    assert "/T_G_I_1" in messages_of(target)
