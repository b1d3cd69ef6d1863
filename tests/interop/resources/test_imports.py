"""Images, depth maps and clouds of files become resources; bad files change nothing."""

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.ply import PlyCloud, parse_ply, write_ply
from maplab_py.interop.resources import depth_maps, matching, point_clouds
from maplab_py.interop.resources.images import ImageImportOptions, export_images, import_images
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.resources.files import missing_files
from maplab_py.storage.resources.store import ResourceStore, resource_path
from maplab_py.vimap import MissionSensor, ResourceOwner, VIMap, mission_sensor_id
from tests.support.stereo_room import StereoRoom


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> StereoRoom:
    return StereoRoom.simulated(tmp_path_factory.mktemp("stereo"))


@pytest.fixture
def vi_map(room: StereoRoom) -> VIMap:
    return room.true_map


def recorded_image(room: StereoRoom, vi_map: VIMap, frame: int) -> Any:
    stamp = vi_map.frames.timestamp_ns[frame]
    camera = vi_map.frames.camera_index[frame]
    return cv2.imread(str(room.recording / f"mav0/cam{camera}/data/{stamp}.png"), 0)


def test_files_match_their_nearest_frame_within_the_tolerance() -> None:
    frames = np.array([100, 200, 300, 400])
    files = np.array([90, 104, 215, 290, 306, 500])
    np.testing.assert_array_equal(matching.matched_files(frames, files, 10), [1, -1, 4, -1])
    np.testing.assert_array_equal(matching.matched_files(frames, files, 15), [1, 2, 4, -1])
    np.testing.assert_array_equal(matching.matched_files(frames, files[:0], 15), [-1] * 4)
    assert len(matching.matched_files(frames[:0], files, 15)) == 0


def test_images_come_to_their_frames(room: StereoRoom, vi_map: VIMap, tmp_path: Path) -> None:
    with_images, report = import_images(vi_map, 0, room.recording)
    assert report.attached == len(vi_map.frames) == report.files_in_folder
    assert report.resource_types == ("raw_images",)
    save_map(with_images, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    store = ResourceStore(loaded, tmp_path / "map")
    for row in range(len(loaded.resources)):
        expected = recorded_image(room, loaded, int(loaded.resources.owner[row]))
        np.testing.assert_array_equal(store.load(row), expected)
    again, repeated = import_images(with_images, 0, room.recording)
    assert again is with_images
    assert (repeated.attached, repeated.frames_that_had_some) == (0, report.attached)


def test_every_second_vertex(room: StereoRoom, vi_map: VIMap) -> None:
    with_images, report = import_images(vi_map, 0, room.recording, ImageImportOptions(every_nth=2))
    vertices = vi_map.frames.vertex[with_images.resources.owner]
    assert report.attached == 2 * ((len(vi_map.vertices) + 1) // 2)
    assert (vertices % 2 == 0).all()


def test_linked_images_stay_links(room: StereoRoom, vi_map: VIMap, tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    shutil.copytree(room.recording, recording)
    linked, _ = import_images(vi_map, 0, recording, ImageImportOptions(link=True, every_nth=5))
    save_map(linked, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    paths = [resource_path(loaded, row, tmp_path / "map") for row in range(len(loaded.resources))]
    assert all(path.is_symlink() for path in paths)
    expected = recorded_image(room, loaded, int(loaded.resources.owner[0]))
    image = ResourceStore(loaded, tmp_path / "map").load(0)
    np.testing.assert_array_equal(image, expected)
    save_map(loaded, tmp_path / "map", overwrite=True)
    assert paths[0].is_symlink()
    shutil.rmtree(recording)
    assert sorted(missing_files(loaded, tmp_path / "map")) == sorted(paths)


def test_exported_images_are_those_that_were_imported(
    room: StereoRoom, vi_map: VIMap, tmp_path: Path
) -> None:
    with_images, _ = import_images(vi_map, 0, room.recording, ImageImportOptions(every_nth=6))
    report = export_images(with_images, Path(), 0, 0, tmp_path)
    assert report.images == len(with_images.resources)
    again, _ = import_images(vi_map, 0, tmp_path)
    np.testing.assert_array_equal(again.resources.owner, with_images.resources.owner)
    pairs = [ResourceStore(each, Path()) for each in (with_images, again)]
    np.testing.assert_array_equal(pairs[0].load(0), pairs[1].load(0))
    with pytest.raises(UserError, match="--overwrite"):
        export_images(with_images, Path(), 0, 0, tmp_path)
    with pytest.raises(UserError, match="no images of type raw_color_images"):
        export_images(with_images, Path(), 0, 4, tmp_path)


def test_wrong_image_folders_are_refused(room: StereoRoom, vi_map: VIMap, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no folder mav0/cam0"):
        import_images(vi_map, 0, tmp_path)
    late = vi_map.replace(
        frames=vi_map.frames.replace(timestamp_ns=vi_map.frames.timestamp_ns + 50_000_000)
    )
    with pytest.raises(UserError, match="no image is within --image_tolerance_ms=1"):
        import_images(late, 0, room.recording)
    recording = tmp_path / "recording"
    shutil.copytree(room.recording, recording)
    first = sorted((recording / "mav0/cam1/data").iterdir())[0]
    cv2.imwrite(str(first), np.zeros((24, 32), dtype=np.uint8))
    with pytest.raises(MapError, match=r"32 x 24.*376 x 240"):
        import_images(vi_map, 0, recording)
    first.write_bytes(first.read_bytes()[:40])
    with pytest.raises(MapError, match="truncated"):
        import_images(vi_map, 0, recording)


def test_depth_maps_keep_their_millimetres(room: StereoRoom, vi_map: VIMap) -> None:
    with_depth, report = depth_maps.import_depth_maps(vi_map, 0, 1, room.depth(1))
    assert report.attached == len(vi_map.vertices)
    owner = int(with_depth.resources.owner[3])
    assert vi_map.frames.camera_index[owner] == 1
    file = room.depth(1) / f"{vi_map.frames.timestamp_ns[owner]}.png"
    depth = ResourceStore(with_depth, Path()).load(3)
    assert depth.dtype == np.uint16
    np.testing.assert_array_equal(depth, cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
    halves, _ = depth_maps.import_depth_maps(
        vi_map, 0, 1, room.depth(1), depth_maps.DepthImportOptions(depth_scale=500.0)
    )
    np.testing.assert_array_equal(ResourceStore(halves, Path()).load(3), 2 * depth)


def test_depths_that_do_not_fit_are_unknown() -> None:
    depth = np.array([[1.2345, np.nan, np.inf], [-1.0, 65.535, 65.536]])
    image: Any = cv2.imdecode(
        np.frombuffer(depth_maps.encoded_depth(depth), np.uint8), cv2.IMREAD_UNCHANGED
    )
    np.testing.assert_array_equal(image, [[1234, 0, 0], [0, 65535, 0]])


def test_wrong_depth_files_are_refused(vi_map: VIMap, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--camera=2: the mission has cameras 0 to 1"):
        depth_maps.import_depth_maps(vi_map, 0, 2, tmp_path)
    with pytest.raises(UserError, match=r"--depth_folder=.*there are no files"):
        depth_maps.import_depth_maps(vi_map, 0, 0, tmp_path)
    with pytest.raises(UserError, match="cannot be read"):
        depth_maps.import_depth_maps(vi_map, 0, 0, tmp_path / "nowhere")
    stamp = int(vi_map.frames.timestamp_ns[0])
    file = tmp_path / f"{stamp}.png"
    for image, message in (
        (np.zeros((240, 376), dtype=np.uint8), "16 bits"),
        (np.zeros((120, 188), dtype=np.uint16), "188 x 120.*376 x 240"),
    ):
        cv2.imwrite(str(file), image)
        with pytest.raises(MapError, match=message):
            depth_maps.import_depth_maps(vi_map, 0, 0, tmp_path)
    file.write_bytes(b"")
    with pytest.raises(MapError, match="damaged"):
        depth_maps.import_depth_maps(vi_map, 0, 0, tmp_path)
    file.rename(tmp_path / "first.png")
    with pytest.raises(UserError, match="time stamp in nanoseconds"):
        depth_maps.import_depth_maps(vi_map, 0, 0, tmp_path)


POINTS = np.array([[0.0, 0.0, 1.0], [1.0, -2.0, 3.0]])
PCD = (
    "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 2\n"
    "HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n0 0 1 5\n1 -2 3 6\n"
)


def test_clouds_belong_to_a_sensor_at_their_time(vi_map: VIMap, tmp_path: Path) -> None:
    sensor = mission_sensor_id(vi_map, 0, MissionSensor.IMU)
    times = vi_map.vertices.timestamp_ns[[1, 2, 3]]
    write_ply(PlyCloud(POINTS), tmp_path / f"{times[0]}.ply")
    write_ply(PlyCloud(POINTS, np.full((2, 3), 9, np.uint8)), tmp_path / f"{times[1]}.ply")
    (tmp_path / f"{times[2]}.pcd").write_text(PCD)
    write_ply(PlyCloud(POINTS), tmp_path / "12345.ply")
    with_clouds, report = point_clouds.import_point_clouds(vi_map, 0, tmp_path, sensor[:6])
    assert report.attached == 3
    assert report.notes == ("1 files are of times outside the mission",)
    assert report.resource_types == ("color_point_cloud", "point_cloud", "point_cloud_w_intensity")
    save_map(with_clouds, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    table = loaded.resources
    assert (table.owner_kind == ResourceOwner.SENSOR).all()
    rows = np.argsort(table.timestamp_ns)
    np.testing.assert_array_equal(table.timestamp_ns[rows], times)
    np.testing.assert_array_equal(table.type[rows], [16, 17, 21])
    store = ResourceStore(loaded, tmp_path / "map")
    cloud = parse_ply(store.load(int(rows[2])), "cloud")
    np.testing.assert_array_equal(cloud.p, POINTS)
    np.testing.assert_array_equal(cloud.intensity, [5.0, 6.0])
    _, again = point_clouds.import_point_clouds(with_clouds, 0, tmp_path, sensor)
    assert (again.attached, again.frames_that_had_some) == (0, 3)


def test_empty_clouds_do_not_stop_the_others(vi_map: VIMap, tmp_path: Path) -> None:
    sensor = mission_sensor_id(vi_map, 0, MissionSensor.IMU)
    times = vi_map.vertices.timestamp_ns[:3].tolist()
    half = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]])
    for time_ns, p in zip(times, (np.zeros((0, 3)), POINTS, half), strict=True):
        write_ply(
            PlyCloud(p, intensity=np.arange(len(p), dtype=np.float64)), tmp_path / f"{time_ns}.ply"
        )
    attached, report = point_clouds.import_point_clouds(vi_map, 0, tmp_path, sensor)
    assert (report.attached, report.frames_that_had_some) == (2, 0)
    assert report.notes == ("1 cloud without finite points left out",)
    assert sorted(attached.resources.timestamp_ns[-2:].tolist()) == times[1:]


def test_wrong_clouds_are_refused(vi_map: VIMap, tmp_path: Path) -> None:
    sensor = mission_sensor_id(vi_map, 0, MissionSensor.IMU)
    file = tmp_path / f"{vi_map.vertices.timestamp_ns[1]}.ply"
    write_ply(PlyCloud(np.zeros((0, 3))), file)
    with pytest.raises(UserError, match="no lidar"):
        point_clouds.import_point_clouds(vi_map, 0, tmp_path)
    with pytest.raises(UserError, match="--sensor_id=zz is unknown"):
        point_clouds.import_point_clouds(vi_map, 0, tmp_path, "zz")
    with pytest.raises(MapError, match="is empty"):
        point_clouds.import_point_clouds(vi_map, 0, tmp_path, sensor)
    write_ply(PlyCloud(np.full((1, 3), np.nan)), file)
    with pytest.raises(MapError, match="not finite"):
        point_clouds.import_point_clouds(vi_map, 0, tmp_path, sensor)
    file.write_bytes(b"ply\nformat")
    with pytest.raises(MapError, match="not a PLY file"):
        point_clouds.import_point_clouds(vi_map, 0, tmp_path, sensor)
    file.rename(tmp_path / "17.ply")
    with pytest.raises(UserError, match="no stamp is within the mission"):
        point_clouds.import_point_clouds(vi_map, 0, tmp_path, sensor)
