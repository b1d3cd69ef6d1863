"""Depth of recorded stereo images against the landmarks of the map."""

from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.dense.resources import FrameResources
from maplab_py.console.session.session import Session
from maplab_py.geometry import se3
from maplab_py.vimap import LandmarkQuality, observer_counts, resources_of
from tests.support.data import shared_data

_MIN_OBSERVERS = 4


@pytest.mark.slow
def test_depth_agrees_with_triangulated_landmarks(tmp_path: Path) -> None:
    recording = shared_data("euroc_mh01_10s")
    with Session() as session:
        session.run("rovioli", datasource_folder=recording, vio_rosbag_end_s=6)
        for command in ("optvi", "rtl", "elq"):
            session.run(command)
        session.run("import_images", dataset_folder=recording, link=True)
        session.run("sdr")
        vi_map = session.vi_map
    is_good = vi_map.landmarks.quality == LandmarkQuality.GOOD
    is_good &= observer_counts(vi_map) >= _MIN_OBSERVERS
    resources = FrameResources(vi_map, Path())
    errors = []
    for row in np.flatnonzero(resources_of(vi_map, (8,))).tolist():
        frame = int(vi_map.resources.owner[row])
        keypoints = np.arange(*vi_map.keypoint_start[frame : frame + 2])
        keypoints = keypoints[vi_map.keypoints.landmark[keypoints] >= 0]
        keypoints = keypoints[is_good[vi_map.keypoints.landmark[keypoints]]]
        p_G = vi_map.p_G[vi_map.keypoints.landmark[keypoints]]
        z = se3.transform(se3.inverse(resources.T_G_C(frame)), p_G)[:, 2]
        u, v = np.round(vi_map.keypoints.uv_px[keypoints]).astype(int).T
        depth = resources.depth(row)[v, u]
        known = (depth > 0.0) & (z > 0.2)
        errors.append(np.abs(depth[known] / z[known] - 1.0))
    assert sum(map(len, errors)) > 2000
    assert np.median(np.concatenate(errors)) < 0.02
