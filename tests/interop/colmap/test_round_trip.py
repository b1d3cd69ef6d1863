"""Map -> COLMAP model -> map, the model as pycolmap sees it, cameras, times of images."""

import dataclasses
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.evaluation.map_comparison import compare_maps
from maplab_py.errors import FlagError, MapError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop import calibration_import, trajectories
from maplab_py.interop.colmap.exporting import export_colmap, model_of_map
from maplab_py.interop.colmap.importing import image_times, import_colmap, read_times
from maplab_py.interop.colmap.model import FILE_NAME
from maplab_py.interop.colmap.options import ColmapExportOptions, ColmapImportOptions
from maplab_py.sensors import Distortion, Projection
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import VIMap, consistency, queries
from tests.interop.small_map import make_map
from tests.support.data import shared_data
from tests.support.scene import Scene
from tests.vimap.test_edits import two_types

PINHOLES = tuple((Projection.PINHOLE, distortion) for distortion in Distortion)
SHARED = (*PINHOLES, (Projection.EXTENDED_UNIFIED, Distortion.NONE))
EVERYTHING = ColmapExportOptions(quality="all")
# in a process of its own: what pycolmap computes from the files
ERRORS = """
import json, sys, numpy as np, pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
errors = []
for image in model.images.values():
    seen = [p for p in image.points2D if p.has_point3D()]
    if seen:
        p_W = np.array([model.point3D(p.point3D_id).xyz for p in seen])
        p_C = image.cam_from_world() * p_W
        uv = image.camera.img_from_cam(p_C)
        errors.append(np.linalg.norm(uv - np.array([p.xy for p in seen]), axis=1))
print(json.dumps([model.num_reg_images(), model.num_points3D(), model.is_valid(),
                  float(np.concatenate(errors).mean())]))
"""


def seen_by_pycolmap(folder: Path) -> list[float]:
    done = subprocess.run(
        [sys.executable, "-c", ERRORS, str(folder)], capture_output=True, text=True, check=True
    )
    return list(json.loads(done.stdout))


@pytest.fixture(scope="module")
def rig_map() -> VIMap:
    return Scene(missions=2, models=SHARED, noise=1.0, landmarks=120).make()


@pytest.mark.parametrize("colmap_format", ["binary", "text"])
def test_everything_that_both_have_comes_back(
    rig_map: VIMap, tmp_path: Path, colmap_format: str
) -> None:
    options = dataclasses.replace(EVERYTHING, colmap_format=colmap_format, colmap_database=True)
    report = export_colmap(rig_map, tmp_path / "model", options)
    assert (report.rigs, report.cameras, report.frames) == (1, len(SHARED), len(rig_map.vertices))
    again, _ = import_colmap(tmp_path / "model", database=tmp_path / "model" / "database.db")
    compared = compare_maps(rig_map, again)
    rows = {row.what: row for row in compared.rows}
    for what in ("missions", "vertices", "frames", "observations"):
        assert (rows[what].only_in_first, rows[what].only_in_second) == (0, 0), what
    assert rows["landmarks"].only_in_second == 0
    assert compared.position_m.largest < 1e-9
    assert compared.rotation_deg.largest < 1e-9
    assert compared.landmark_position_m.largest < 1e-9
    assert compared.keypoint_px.largest < 1e-9
    assert compared.time_ns.largest == 0.0
    assert compared.descriptors_differing == 0
    assert not consistency.check_consistency(again).errors


def test_pycolmap_sees_the_same_errors(rig_map: VIMap, tmp_path: Path) -> None:
    report = export_colmap(rig_map, tmp_path, EVERYTHING)
    images, points, is_valid, mean_px = seen_by_pycolmap(tmp_path)
    assert (images, points, is_valid) == (report.images, report.points, True)
    assert abs(mean_px - report.mean_reprojection_error_px) < 1e-6


def test_a_model_without_side_file_is_a_mission_of_each_rig(tmp_path: Path) -> None:
    vi_map = Scene(missions=1, vertices=6, models=PINHOLES[:2]).make()
    export_colmap(vi_map, tmp_path, EVERYTHING)
    (tmp_path / FILE_NAME).unlink()
    again, report = import_colmap(tmp_path)
    assert len(again.missions) == 1
    assert not queries.is_metric(again, 0)
    assert "arbitrary" in report.notes[0]
    # the body is the first camera now; times come from the images' names
    T_G_C = se3.compose(
        vi_map.T_G_I,
        vi_map.sensors.T_I_C(*_ids(vi_map))[0],
    )
    assert np.allclose(again.T_G_I, T_G_C, atol=1e-9)
    assert np.array_equal(again.vertices.timestamp_ns, vi_map.vertices.timestamp_ns)
    twice, _ = import_colmap(tmp_path)
    assert np.array_equal(again.vertices.id, twice.vertices.id)
    save_map(again, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    assert compare_maps(again, loaded).position_m.largest == 0.0
    assert not queries.is_metric(loaded, 0)


def _ids(vi_map: VIMap) -> tuple[str, str]:
    imu, rig = vi_map.sensors.sensors
    return imu, rig


def test_models_of_older_versions_have_no_rigs(tmp_path: Path) -> None:
    vi_map = Scene(vertices=5).make()
    export_colmap(vi_map, tmp_path, EVERYTHING)
    for name in ("rigs.bin", "frames.bin", FILE_NAME):
        (tmp_path / name).unlink()
    again, _ = import_colmap(tmp_path)
    assert (len(again.missions), len(again.vertices)) == (1, 5)


def test_a_refined_model_keeps_the_ids_that_still_apply(tmp_path: Path) -> None:
    vi_map = Scene(vertices=5, landmarks=40).make()
    export_colmap(vi_map, tmp_path, EVERYTHING)
    exported = model_of_map(vi_map, quality="all").model
    point = exported.images.point.copy()
    point[point == 0] = -1  # what COLMAP does when it filters a point
    shutil.copy(tmp_path / FILE_NAME, tmp_path / "kept")
    filtered = dataclasses.replace(
        exported, images=dataclasses.replace(exported.images, point=point)
    )
    from maplab_py.interop.colmap.records import binary_files

    for name, content in binary_files(filtered).items():
        (tmp_path / name).write_bytes(b"".join(content))
    again, report = import_colmap(tmp_path)
    rows = {row.what: row for row in compare_maps(vi_map, again).rows}
    assert report.points_without_observation == 1
    assert rows["landmarks"].only_in_second == 0
    assert rows["vertices"].only_in_first == 0


def test_alignment_finds_scale_gravity_and_the_lever_arm(tmp_path: Path) -> None:
    vi_map = Scene(vertices=10, landmarks=60).make()
    export_colmap(vi_map, tmp_path / "model", EVERYTHING)
    turn = se3.make(so3.exp([0.4, -0.3, 0.8]), [3.0, 2.0, 1.0])
    truth = trajectories.Trajectory(vi_map.vertices.timestamp_ns, se3.compose(turn, vi_map.T_G_I))
    trajectories.write_tum(truth, tmp_path / "truth.txt")
    options = ColmapImportOptions(align_to=str(tmp_path / "truth.txt"))
    again, report = import_colmap(tmp_path / "model", options)
    assert np.allclose(again.T_G_I, truth.T_R_B, atol=1e-6)
    assert report.scale == pytest.approx(1.0, abs=1e-6)
    assert report.aligned_vertices == 10
    assert queries.is_metric(again, 0)


def test_scale_and_gravity_by_flags(tmp_path: Path) -> None:
    vi_map = Scene(vertices=5).make()
    export_colmap(vi_map, tmp_path, EVERYTHING)
    (tmp_path / FILE_NAME).unlink()
    again, _ = import_colmap(tmp_path, ColmapImportOptions(scale=2.0, gravity="0,1,0"))
    steps = np.linalg.norm(np.diff(again.T_G_I[:, 4:], axis=0), axis=1)
    plain, _ = import_colmap(tmp_path)
    assert np.allclose(steps, 2.0 * np.linalg.norm(np.diff(plain.T_G_I[:, 4:], axis=0), axis=1))
    turned = so3.rotate(
        so3.multiply(again.T_G_I[:, :4], so3.inverse(plain.T_G_I[:, :4])), [0, 1, 0]
    )
    assert np.allclose(turned, [0.0, 0.0, -1.0], atol=1e-9)
    assert queries.is_metric(again, 0)


def test_omni_cameras_are_refused_or_undistorted(tmp_path: Path) -> None:
    vi_map = Scene(vertices=4, models=((Projection.UNIFIED, Distortion.RADTAN),)).make()
    with pytest.raises(UserError, match="unified-projection model: give --undistort"):
        export_colmap(vi_map, tmp_path)
    assert not list(tmp_path.iterdir())
    options = dataclasses.replace(EVERYTHING, undistort=True)
    report = export_colmap(vi_map, tmp_path, options)
    assert report.mean_reprojection_error_px < 1e-6
    assert seen_by_pycolmap(tmp_path)[3] < 1e-6


def test_files_are_not_replaced_unasked(tmp_path: Path) -> None:
    vi_map = make_map()
    export_colmap(vi_map, tmp_path, EVERYTHING)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(UserError, match="exists already: give --overwrite"):
        export_colmap(vi_map, tmp_path, EVERYTHING)
    with pytest.raises(UserError, match="in the other format"):
        export_colmap(vi_map, tmp_path, dataclasses.replace(EVERYTHING, colmap_format="text"))
    export_colmap(vi_map, tmp_path, EVERYTHING, overwrite=True)
    assert before == {path.name: path.read_bytes() for path in tmp_path.iterdir()}


@pytest.mark.slow
def test_a_recorded_map(tmp_path: Path) -> None:
    """The bars: seconds, and every pose and observation back."""
    vi_map, _ = load_map(shared_data("maplab_maps/tango_handheld"))
    start_s = time.perf_counter()
    report = export_colmap(vi_map, tmp_path, EVERYTHING)
    exported_s = time.perf_counter()
    again, _ = import_colmap(tmp_path)
    imported_s = time.perf_counter()
    compared = compare_maps(vi_map, again)
    rows = {row.what: row for row in compared.rows}
    assert rows["observations"].only_in_first == rows["observations"].only_in_second == 0
    assert max(compared.position_m.largest, compared.rotation_deg.largest) < 1e-9
    assert exported_s - start_s < 5.0
    assert imported_s - exported_s < 5.0
    assert report.images == 969


def test_maps_without_images_have_nothing_to_export(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no images that COLMAP could use"):
        export_colmap(VIMap(), tmp_path)
    with pytest.raises((MapError, UserError), match="has no COLMAP model"):
        import_colmap(tmp_path)


OPENCV = "1 OPENCV 752 480 458.6 457.2 367.7 248.8 -0.28 0.07 0.0002 0.00002"


def cameras_txt(folder: Path, *lines: str) -> Path:
    path = folder / "cameras.txt"
    path.write_text("# Camera list with one line of data per camera:\n" + "\n".join(lines) + "\n")
    return path


def test_a_file_of_one_camera(tmp_path: Path) -> None:
    calibration = calibration_import.import_calibration(cameras_txt(tmp_path, OPENCV))
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
    calibration = calibration_import.import_calibration(tmp_path / "model")
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
        (("1 OPENCV 752",), r"cameras\.txt:2: .* wants id, camera model, width"),
        (("1 NEWEST 752 480 1 2 3",), r"cameras\.txt:2: .* unknown camera model NEWEST"),
        (("1 PINHOLE 752 480 1 2 3",), r"cameras\.txt:2: .* wants PINHOLE with 4 parameters"),
        (("1 PINHOLE 752 480 1 2 3 4 5",), r"cameras\.txt:2: .* wants PINHOLE with 4 parameters"),
        (("1 PINHOLE 752 480 1 2 3 nan",), r"cameras\.txt:2: .* not finite"),
        (("1 PINHOLE 752 x 1 2 3 4",), r"cameras\.txt:2: .* wants id, camera model, width"),
        (("1 PINHOLE 0 480 1 2 3 4",), "the images of camera 1 have no pixels"),
        (("1 DIVISION 752 480 1 2 3 4 5",), "maplab has no camera model DIVISION"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, lines: tuple[str, ...], message: str) -> None:
    with pytest.raises((MapError, UserError), match=message):
        calibration_import.import_calibration(cameras_txt(tmp_path, *lines))


@pytest.mark.parametrize(("name", "number"), [("SIFT", 3), ("Binary", 0)])
def test_a_database_of_one_type(tmp_path: Path, name: str, number: int) -> None:
    vi_map = two_types()
    options = ColmapExportOptions(quality="all", colmap_database=True, colmap_feature_type=name)
    export_colmap(vi_map, tmp_path, options)
    again, _ = import_colmap(tmp_path, database=tmp_path / "database.db")
    of_type = vi_map.feature_type == number
    assert len(again.keypoints) == np.count_nonzero(of_type)
    size = 128 if number else 48
    np.testing.assert_array_equal(
        again.keypoints.descriptor[:, :size], vi_map.keypoints.descriptor[of_type, :size]
    )
    assert set(again.feature_type.tolist()) == {number}


def test_types_that_are_not_there(tmp_path: Path) -> None:
    vi_map = two_types()
    with pytest.raises(UserError, match="no such keypoints; its types: Binary, SIFT"):
        export_colmap(vi_map, tmp_path, ColmapExportOptions(colmap_feature_type="R2D2"))
    with pytest.raises(FlagError, match="--colmap_feature_type: surf is no feature type"):
        export_colmap(vi_map, tmp_path, ColmapExportOptions(colmap_feature_type="surf"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("names", "times_ns"),
    [
        (("cam0/1403715273262142976.jpg",), [1403715273262142976]),
        (
            ("left_1403715273262143.png", "left_1403715273312143.png"),
            [1403715273262143000, 1403715273312143000],
        ),
        (("1403715273312.png", "1403715273262.png"), [1403715273312000000, 1403715273262000000]),
        (("a/1403715273.262142976.png",), [1403715273262142976]),
        (("frame_12.5.png", "frame_12.75.png"), [12_500_000_000, 12_750_000_000]),
        (("600000000000.png", "600050000000.png"), [600_000_000_000, 600_050_000_000]),
    ],
)
def test_stamps_in_names(names: tuple[str, ...], times_ns: list[int]) -> None:
    assert image_times(names, ColmapImportOptions()).tolist() == times_ns


def test_the_unit_of_one_number_is_not_guessed() -> None:
    names = ("left_1403715273262143.png",)
    with pytest.raises(MapError, match="--time_unit"):
        image_times(names, ColmapImportOptions())
    assert image_times(names, ColmapImportOptions(time_unit="us")).tolist() == [1403715273262143000]


def test_cameras_of_a_rig_that_are_microseconds_apart() -> None:
    names = tuple(
        f"cam{c}/{600_000_000_000 + 50_000_000 * k + 900 * c}.png" for k in range(4) for c in (0, 1)
    )
    times_ns = image_times(names, ColmapImportOptions())
    assert times_ns[:3].tolist() == [600_000_000_000, 600_000_000_900, 600_050_000_000]


def test_a_file_of_stamps(tmp_path: Path) -> None:
    file = tmp_path / "times.txt"
    file.write_text("# name, time [ms]\nImage 1.png, 1000.5\nb.png 1033.5\n")
    assert read_times(file) == {"Image 1.png": 1_000_500_000, "b.png": 1_033_500_000}
    file.write_text('image;timestamp [ms]\n"Image 1.png";1000.5\n"b.png";"1033.5"\n')
    assert read_times(file) == {"Image 1.png": 1_000_500_000, "b.png": 1_033_500_000}
    file.write_text("a.png later\n")
    with pytest.raises(MapError, match=":1: wants an image name and a time stamp"):
        read_times(file)


@pytest.mark.parametrize("name", ["image.png", "cam0/000123.png", "1" * 25 + ".png"])
def test_names_without_stamp_are_refused(name: str) -> None:
    with pytest.raises(UserError, match="has no time stamp"):
        image_times((name,), ColmapImportOptions())


def test_frames_share_the_time_of_their_order() -> None:
    names = ("left/2.png", "right/1.png", "left/1.png")
    options = ColmapImportOptions(timestamps_from="order", order_interval_s=2.0)
    assert image_times(names, options).tolist() == [4e9, 2e9, 2e9]
