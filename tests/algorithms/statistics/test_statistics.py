from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.keyframing.heuristic import keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.statistics.statistics import bytes_by_kind, map_distributions, map_size
from maplab_py.storage.native import save_map
from maplab_py.vimap import VIMap
from tests.vimap.builders import SAMPLES, walk_map


def test_distributions_are_those_of_the_map():
    m = walk_map()
    lines = {line.quantity: line for line in map_distributions(m).quantities}
    assert lines["vertices per mission"].mean == 12.0
    step = np.linalg.norm(np.diff(m.vertices.T_M_I[:, 4:], axis=0), axis=1)
    assert lines["distance of vertices [m]"].mean == pytest.approx(step.mean())
    assert lines["time between vertices [s]"].largest == pytest.approx(0.1)
    assert lines["keypoints per image"].median == np.median(m.frames.keypoint_count)
    assert lines["observations per landmark"].count == len(m.landmarks)
    # every keypoint of this map has a landmark, and its track is the landmark
    counts = np.bincount(m.keypoints.landmark)
    assert lines["keypoints per track"].mean == pytest.approx(counts[counts > 0].mean())
    assert lines["IMU samples per edge"].least == SAMPLES
    assert lines["angle between rays of a landmark [deg]"].largest > 10.0


def test_an_empty_map_has_no_distributions():
    assert map_distributions(VIMap()).quantities == ()


def test_bytes_are_all_counted_once():
    kinds = bytes_by_kind(walk_map())
    m = walk_map()
    assert kinds["descriptors"] == (len(m.keypoints), m.keypoints.descriptor.nbytes)
    report = map_size(m)
    assert sum(kind.share for kind in report.kinds) == pytest.approx(1.0)
    assert report.megabytes_in_memory == pytest.approx(sum(kind.megabytes for kind in report.kinds))
    assert report.megabytes_on_disk is None


def test_savings_are_those_of_the_commands(tmp_path: Path):
    m = walk_map(vertices=40, landmarks=200)
    options = KeyframingOptions(every_nth_vertex=5, min_shared_landmarks_obs=0)
    save_map(m, tmp_path / "walk")
    report = map_size(m, folder=tmp_path / "walk", keyframing=options)
    savings = {saving.command.split()[0]: saving for saving in report.savings}
    thin, _ = keyframe(m, options)
    expected = sum(size for _, size in bytes_by_kind(thin).values()) * 1e-6
    assert savings["keyframe_heuristic"].megabytes == pytest.approx(expected)
    assert savings["keyframe_heuristic"].saved > 0.3
    assert savings["landmark_sparsify"].saved > 0.0
    assert savings["generate_summary_map_and_save_to_disk"].saved > 0.0
    on_disk = sum(path.stat().st_size for path in (tmp_path / "walk").rglob("*") if path.is_file())
    assert report.megabytes_on_disk == pytest.approx(on_disk * 1e-6)
    assert report.megabytes_of_resources == 0.0
