"""Cameras of COLMAP models as calibrations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.calibration_import import import_calibration
from maplab_py.interop.colmap.exporting import export_colmap
from maplab_py.interop.colmap.options import ColmapExportOptions
from maplab_py.sensors import Distortion
from tests.interop.colmap.test_round_trip import rig_map as rig_map_fixture

rig_map = rig_map_fixture
OPENCV = "1 OPENCV 752 480 458.6 457.2 367.7 248.8 -0.28 0.07 0.0002 0.00002"


def cameras_txt(folder: Path, *lines: str) -> Path:
    path = folder / "cameras.txt"
    path.write_text("# Camera list with one line of data per camera:\n" + "\n".join(lines) + "\n")
    return path


def test_a_file_of_one_camera(tmp_path: Path) -> None:
    calibration = import_calibration(cameras_txt(tmp_path, OPENCV))
    assert calibration.format == "COLMAP"
    assert not calibration.imu_id
    rig = calibration.sensors.camera_rig(calibration.rig_id)
    (camera,) = rig.cameras
    assert camera.distortion is Distortion.RADTAN
    # the centre of the first pixel is at 0.5 in COLMAP
    np.testing.assert_allclose(camera.intrinsics, [458.6, 457.2, 367.2, 248.3])
    np.testing.assert_allclose(camera.distortion_parameters, [-0.28, 0.07, 0.0002, 0.00002])
    np.testing.assert_array_equal(rig.T_B_C, [se3.identity()])


@pytest.mark.parametrize("form", ["binary", "text"])
def test_the_rig_of_a_model(rig_map, tmp_path: Path, form: str) -> None:  # type: ignore[no-untyped-def]
    one = rig_map
    options = ColmapExportOptions(colmap_format=form)
    export_colmap(one, tmp_path / "model", options)
    calibration = import_calibration(tmp_path / "model")
    rig = calibration.sensors.camera_rig(calibration.rig_id)
    (original,) = (sensor for sensor in one.sensors.sensors.values() if hasattr(sensor, "cameras"))
    assert len(rig.cameras) == len(original.cameras)
    for camera, other in zip(rig.cameras, original.cameras, strict=True):
        assert camera.distortion is other.distortion
        np.testing.assert_allclose(camera.intrinsics, other.intrinsics, atol=1e-9)
    expected = se3.compose(se3.inverse(original.T_B_C[0]), original.T_B_C)
    np.testing.assert_allclose(np.abs(rig.T_B_C), np.abs(expected), atol=1e-9)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ((), "has 0 cameras"),
        ((OPENCV, OPENCV.replace("1 ", "2 ", 1)), "has 2 cameras, and does not say how they are"),
        (("1 OPENCV 752",), r"cameras\.txt:2: wants id, camera model, width"),
        (("1 NEWEST 752 480 1 2 3",), r"cameras\.txt:2: wants id, camera model"),
        (("1 PINHOLE 752 480 1 2 3",), "PINHOLE has 4 parameters that are numbers, not 3"),
        (("1 PINHOLE 752 480 1 2 3 nan",), "PINHOLE has 4 parameters that are numbers"),
        (("1 PINHOLE 752 x 1 2 3 4",), "invalid literal"),
        (("1 PINHOLE 0 480 1 2 3 4",), "the images have no pixels"),
        (("1 DIVISION 752 480 1 2 3 4 5",), "maplab has no camera model DIVISION"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, lines: tuple[str, ...], message: str) -> None:
    with pytest.raises((MapError, UserError), match=message):
        import_calibration(cameras_txt(tmp_path, *lines))


def test_a_cut_binary_file_is_refused(rig_map, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    export_colmap(rig_map, tmp_path / "model", ColmapExportOptions())
    path = tmp_path / "model" / "cameras.bin"
    data = path.read_bytes()
    for size in range(0, len(data), 29):
        path.write_bytes(data[:size])
        with pytest.raises(MapError, match=r"cameras\.bin: is damaged"):
            import_calibration(path)
