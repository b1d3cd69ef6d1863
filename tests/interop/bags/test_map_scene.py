"""export_mcap: the whole map as messages of ROS 2, read back with rosbags."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.interop.bags.map_scene import export_mcap
from maplab_py.interop.bags.sensor_messages import cloud_of
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.tables import LoopClosureEdges
from tests.interop.bags.small_bags import map_with_resources, messages_of

pytest.importorskip("rosbags")


def test_poses_landmarks_closures_and_images_read_back(tmp_path: Path) -> None:
    vi_map, images, _ = map_with_resources()
    landmarks = vi_map.landmarks
    quality = np.full(len(landmarks), LandmarkQuality.GOOD, dtype=np.int8)
    closure = LoopClosureEdges.filled(1, from_vertex=[0], to_vertex=[2])
    vi_map = vi_map.replace(
        landmarks=landmarks.replace(quality=quality), loop_closure_edges=closure
    )
    report = export_mcap(vi_map, tmp_path, tmp_path / "scene")
    assert (tmp_path / "scene" / "scene.mcap").is_file()
    read = messages_of(tmp_path / "scene")
    assert {topic.topic: topic.messages for topic in report.topics} == {
        topic: len(messages) for topic, messages in read.items()
    }
    by_kind = {topic.rsplit("/", 1)[1]: messages for topic, messages in read.items()}
    stamped = [m for topic, messages in read.items() if topic.endswith("/pose") for m in messages]
    poses = {time_ns: _position(message.pose) for time_ns, message in stamped}
    assert np.allclose(
        [poses[t] for t in vi_map.vertices.timestamp_ns.tolist()], vi_map.T_G_I[:, 4:]
    )
    if len(landmarks):
        cloud = cloud_of(by_kind["landmarks"][0][1], "landmarks")
        assert np.allclose(cloud.p, vi_map.p_G, atol=1e-5)
    ends = by_kind["loop_closures"][0][1].points
    assert np.allclose([[p.x, p.y, p.z] for p in ends], vi_map.T_G_I[[0, 2], 4:])
    assert len(by_kind["image_raw"]) == len(images)


def _position(pose: object) -> list[float]:
    p = pose.position  # type: ignore[attr-defined]
    return [p.x, p.y, p.z]


def test_images_are_left_out_on_request(tmp_path: Path) -> None:
    vi_map = map_with_resources()[0]
    report = export_mcap(vi_map, tmp_path, tmp_path / "scene", images=False)
    assert not any("image" in topic.topic for topic in report.topics)


def test_an_empty_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no vertices: there is nothing to show"):
        export_mcap(VIMap(), tmp_path, tmp_path / "scene")
