"""A model that pycolmap makes of recorded images, aligned with their ground truth."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from maplab_py.geometry import se3
from maplab_py.geometry.alignment import umeyama
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.colmap.importing import import_colmap
from maplab_py.interop.colmap.options import ColmapImportOptions
from maplab_py.interop.trajectories import read_trajectory
from maplab_py.vimap import MissionSensor
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.descriptors import FeatureType
from tests.support.data import shared_data

RECONSTRUCT = Path(__file__).with_name("reconstruct.py")
CENTRES = """
import json, sys, pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
print(json.dumps(sorted([i.name, list(i.projection_center())] for i in model.images.values())))
"""


def ate_m(p_A: np.ndarray, p_B: np.ndarray) -> float:
    T_A_B, scale = umeyama(p_A, p_B, with_scale=True)
    error = se3.transform(T_A_B, scale * p_B) - p_A
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


@pytest.mark.slow
def test_a_reconstruction_of_recorded_images(tmp_path: Path) -> None:
    images = shared_data("euroc_v101_keyframes/mav0/cam0/data")
    truth_file = shared_data("euroc_imu/V101.gt.csv")
    names = sorted(path.name for path in images.glob("*.jpg"))[3:15]
    program = [sys.executable, str(RECONSTRUCT), str(images), str(tmp_path), *names]
    subprocess.run(program, check=True, capture_output=True)
    done = subprocess.run(
        [sys.executable, "-c", CENTRES, str(tmp_path / "0")],
        check=True,
        capture_output=True,
        text=True,
    )
    centres = json.loads(done.stdout)
    options = ColmapImportOptions(align_to=str(truth_file), images=str(images))
    vi_map, report = import_colmap(tmp_path / "0", options, database=tmp_path / "database.db")
    times_ns = np.array([int(Path(name).stem) for name, _ in centres])
    assert np.array_equal(vi_map.vertices.timestamp_ns, times_ns)
    assert report.images_as_resources == len(centres) >= 10
    assert not check_consistency(vi_map).errors
    assert not vi_map.missions.sensor_id[0, MissionSensor.IMU].any()
    assert set(vi_map.feature_type.tolist()) == {int(FeatureType.SIFT)}
    truth = read_trajectory(truth_file)
    T_G_I, valid = interpolate_poses(truth.times_ns, truth.T_R_B, times_ns)
    p_G = T_G_I[valid, 4:]
    of_model = ate_m(p_G, np.array([centre for _, centre in centres])[valid])
    error = vi_map.T_G_I[valid, 4:] - p_G
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) == pytest.approx(of_model, abs=1e-6)
    assert of_model < 0.1
