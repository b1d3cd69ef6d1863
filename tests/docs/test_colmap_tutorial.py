"""The page "from COLMAP to a summary map", on a model of rendered images with SIFT features."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from maplab_py.algorithms.image_features import extraction, tracks
from maplab_py.algorithms.image_features.options import ExtractionOptions, FeatureTrackOptions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.tracks import init_tracks
from maplab_py.console.commands.lines import split_commands
from maplab_py.console.session.session import Session
from maplab_py.geometry import se3
from maplab_py.interop.colmap.exporting import export_colmap
from maplab_py.interop.colmap.model import FILE_NAME
from maplab_py.interop.colmap.options import ColmapExportOptions
from maplab_py.interop.resources.images import import_images
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.storage.summary_map import read_summary_map
from maplab_py.vimap import MissionSensor, VIMap, mission_sensor_id
from tests.algorithms.image_features.test_extraction import room
from tests.docs.markdown import blocks
from tests.support.data import REPOSITORY
from tests.support.stereo_room import StereoRoom

__all__ = ["room"]
PAGE = REPOSITORY / "docs" / "colmap_to_summary_map.md"


def described(room: StereoRoom) -> VIMap:
    """Return the left camera's images with landmarks of SIFT features alone."""
    vi_map = import_images(room.true_map, 0, room.recording)[0]
    options = ExtractionOptions(max_features=300, replace=True)
    blank = vi_map.frames.replace(descriptor_blocks=np.array([None] * len(vi_map.frames)))
    sift, _ = extraction.extract_features(vi_map.replace(frames=blank), Path(), options)
    tracked, _ = tracks.track_features(sift, FeatureTrackOptions())
    return init_tracks(tracked, LandmarkQualityOptions())[0]


def write_model(vi_map: VIMap, folder: Path) -> None:
    """Write what a user of COLMAP has: model, database, images, and a trajectory of the camera."""
    export_colmap(vi_map, folder / "0", ColmapExportOptions(colmap_database=True))
    (folder / "0" / FILE_NAME).unlink()
    (folder / "0" / "database.db").rename(folder / "database.db")
    from maplab_py.interop.colmap.reading import read_model

    names = read_model(folder / "0").images.name
    store = ResourceStore(vi_map, Path())
    for row, frame in enumerate(vi_map.resources.owner.tolist()):
        stamp = f"{vi_map.frames.timestamp_ns[frame]:019d}"
        camera = f"cam{vi_map.frames.camera_index[frame]}/"
        name = next(name for name in names if stamp in name and camera in name)
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), store.load(row))
    rig = mission_sensor_id(vi_map, 0, MissionSensor.NCAMERA)
    imu = mission_sensor_id(vi_map, 0, MissionSensor.IMU)
    T_G_C = se3.compose(vi_map.T_G_I, vi_map.sensors.T_I_C(imu, rig)[0])
    rows = [
        f"{time_ns // 10**9}.{time_ns % 10**9:09d} "
        + " ".join(f"{value:.12f}" for value in [*pose[4:], *pose[:4]])
        for time_ns, pose in zip(vi_map.vertices.timestamp_ns.tolist(), T_G_C.tolist(), strict=True)
    ]
    (folder / "camera.tum").write_text("\n".join(rows) + "\n")


def test_the_page_runs(room: StereoRoom, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_model(described(room), tmp_path / "office")
    with Session() as session:
        reports = {}
        for _, text in blocks(PAGE, "maplab"):
            for words in split_commands(text):
                report = session.execute(session.parse(words))
                assert report.failure == "" or words[0] == "lc", words
                reports[words[0]] = report
        assert set(session.vi_map.feature_type.tolist()) == {3}
    summary = read_summary_map(tmp_path / "office_summary")
    assert summary.descriptor_kind == (128, 3, 0)
    assert len(summary.p_G) > 100
    assert reports["localize"].localized == reports["localize"].queries >= 4
    assert reports["localize"].position_error_m.largest < 0.05
    lines = (tmp_path / "poses.csv").read_text().splitlines()
    assert len(lines) == 1 + reports["localize"].queries
