"""The command rovioli: from a recording to a map that the other commands take."""

import tempfile
from pathlib import Path

import numpy as np
import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import EstimationError, FlagError, MapError, UserError
from maplab_py.frontend import finishing
from maplab_py.frontend.reports import MappingReport
from maplab_py.simulation.scenario import MotionOptions
from maplab_py.storage.native import SaveReport, load_map, save_map
from maplab_py.vimap import VIMap, consistency
from tests.frontend.simulated import replayed
from tests.interop.recordings.written import make_content, write_folder
from tests.support.data import shared_data

REST_FIRST = (
    MotionOptions(kind="stationary", duration_s=2.0),
    MotionOptions(kind="room_scan", duration_s=4.0, turns=0.15),
)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a map folder to replay: at rest first, then a walk."""
    folder = tmp_path_factory.mktemp("recording") / "walk"
    save_map(replayed(REST_FIRST, 2)[0], folder)
    return folder


def run(session: Session, folder: Path | None, **flags: object) -> MappingReport:
    words = {} if folder is None else {"datasource_folder": folder}
    report = session.run("rovioli", **words, **flags)
    assert isinstance(report, MappingReport)
    return report


def test_the_map_is_saved_and_selected(walk: Path, tmp_path: Path) -> None:
    target = tmp_path / "map"
    with Session() as session:
        report = run(session, walk, save_map_folder=target)
        assert report.failure == ""
        assert report.map_folder == target
        assert session.maps.selected_key == report.map_key == "map"
        assert session.maps.selected.is_saved
        assert session.maps.selected.folder == target
        vi_map, _ = load_map(target)
        assert consistency.check_consistency(vi_map).failure == ""
        assert len(vi_map.vertices) == len(session.vi_map.vertices) == report.vertices > 50
        assert list(session.vi_map.missions.name) == ["map"]
        assert len(report.starts) == 1
        assert 0.4 < report.starts[0].time_s < 2.0


@pytest.mark.slow
def test_a_localisation_map_keeps_a_share_of_the_landmarks(walk: Path) -> None:
    with Session() as session:
        whole = run(session, walk, map_key="all", optimize_map_to_localization_map=True)
        part = run(
            session, walk, map_key="part", optimize_map_to_localization_map=True,
            localization_map_keep_landmark_fraction=0.25,
        )  # fmt: skip
    assert whole.vertices == part.vertices
    assert 0.1 * whole.good_landmarks < part.good_landmarks <= 0.3 * whole.good_landmarks


def test_poses_are_exported_and_not_overwritten(walk: Path, tmp_path: Path) -> None:
    poses = tmp_path / "poses.csv"
    with Session() as session:
        report = run(
            session, walk, rovioli_run_map_builder=False, export_estimated_poses_to_csv=poses
        )
        assert len(session.maps) == 0
        assert report.poses_file == poses
        assert len(poses.read_text().splitlines()) == 1 + report.estimated_frames
        with pytest.raises(UserError, match=r"poses.csv exists already: give --overwrite"):
            run(session, walk, export_estimated_poses_to_csv=poses)


def test_an_existing_target_is_refused_before_any_work(walk: Path, tmp_path: Path) -> None:
    target = tmp_path / "map"
    vi_map, _ = replayed(REST_FIRST, 2)
    save_map(vi_map, target)
    with Session() as session:
        with pytest.raises(UserError, match="already; use --overwrite_existing_map"):
            run(session, walk, save_map_folder=target)
        (tmp_path / "other").mkdir()
        (tmp_path / "other" / "notes.txt").write_text("mine")
        with pytest.raises(UserError, match="not empty and not a map"):
            run(session, walk, save_map_folder=tmp_path / "other")
        with pytest.raises(UserError, match=r"notes.txt is not a folder; choose another") as caught:
            run(session, walk, save_map_folder=tmp_path / "other" / "notes.txt" / "new" / "map")
        assert "\n" not in str(caught.value)
        report = run(session, walk, save_map_folder=target, overwrite_existing_map=True)
        assert len(load_map(target)[0].vertices) == report.vertices


def test_a_map_that_cannot_be_saved_where_it_should_is_saved_elsewhere(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, spare = tmp_path / "full" / "map", tmp_path / "spare"
    spare.mkdir()
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(spare))

    def on_a_full_disk(vi_map: VIMap, folder: Path, **options: bool) -> SaveReport:
        if folder == target:
            raise UserError(f"{folder}: cannot be saved (No space left on device)")
        return save_map(vi_map, folder, **options)

    monkeypatch.setattr(finishing, "save_map", on_a_full_disk)
    with Session() as session:
        report = run(session, walk, save_map_folder=target)
        assert report.map_folder is not None
        assert report.map_folder.is_relative_to(spare)
        expected = f"{target}: cannot be saved (No space left on device); the map is saved to "
        assert report.failure == f"{expected}{report.map_folder} instead"
        assert len(load_map(report.map_folder)[0].vertices) == len(session.vi_map.vertices)
        assert not target.exists()
        # neither place has room
        monkeypatch.setattr(finishing, "save_map", lambda *_, **__: refuse())
        report = run(session, walk, save_map_folder=tmp_path / "other", map_key="second")
        assert report.map_folder is None
        assert report.failure == "no room (the map is in memory as 'second': save it)"
        assert len(session.vi_map.vertices) == report.vertices


def refuse() -> SaveReport:
    raise UserError("no room")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({}, "no recording: give --datasource_folder"),
        ({"datasource_folder": "nowhere"}, "nowhere does not exist: give a folder"),
        ({"datasource_folder": "empty"}, "is no recording: wants a folder with mav0/cam0"),
        ({"datasource_folder": "empty", "datasource_type": "map"}, "empty is not a map folder"),
        ({"datasource_folder": "WALK", "datasource_type": "euroc"}, "give --datasource_type=map"),
        ({"datasource_folder": "WALK", "map_mission": "ffff"}, "no mission"),
        ({"datasource_folder": "images", "map_mission": "ff"}, "images is not a map folder"),
        ({"datasource_folder": "images", "datasource_type": "rosbag"}, "is a EuRoC folder"),
        ({"datasource_rosbag": "x.bag", "datasource_type": "euroc"}, "needs --datasource_folder"),
        ({"datasource_rosbag": "x.bag", "datasource_folder": "images"}, "not both"),
        ({"datasource_rosbag": "x.bag"}, "x.bag does not exist"),
        ({"datasource_folder": "images", "camera_topics": "/a,/b"}, "apply to bags only"),
        (
            {"datasource_folder": "images", "feature_tracking_descriptor_type": "freak"},
            "must be one of brisk, xfeat",
        ),
        (
            {"datasource_folder": "images", "feature_tracking_descriptor_type": "xfeat"},
            "XFeat is not installed on this computer: run install_features xfeat",
        ),
        ({"datasource_folder": "images", "rovio_image_mask_path": "m.png"}, "cannot be read"),
        ({"datasource_folder": "images", "vio_num_keyframes": 1}, "vio_num_keyframes"),
        ({"datasource_folder": "WALK", "map_key": "a/b"}, "cannot be a map key"),
    ],
)
def test_wrong_requests_are_refused_in_one_line(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: dict[str, str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    (tmp_path / "empty").mkdir()
    write_folder(make_content(), tmp_path / "images")
    given: dict[str, object] = {
        name: Path(value.replace("WALK", str(walk))) if name.startswith("datasource_") else value
        for name, value in flags.items()
    }
    if "datasource_type" in flags:
        given["datasource_type"] = flags["datasource_type"]
    with Session() as session:
        with pytest.raises((UserError, FlagError, MapError), match=message) as error:
            session.run("rovioli", **given)
        assert "\n" not in str(error.value)
        assert len(session.maps) == 0


def test_cameras_that_are_not_triggered_together_are_named(tmp_path: Path) -> None:
    folder = write_folder(make_content(), tmp_path / "images")
    table = folder / "mav0" / "cam1" / "data.csv"
    head, *rows = table.read_text().splitlines()
    later = [f"{int(stamp) + 20_000_000},{name}" for stamp, name in (r.split(",") for r in rows)]
    table.write_text("\n".join([head, *later]) + "\n")
    with Session() as session:
        with pytest.raises(EstimationError, match="of the images are alone") as caught:
            run(session, folder)
        assert "raise --vio_nframe_sync_tolerance_ns" in str(caught.value)
        with pytest.raises(EstimationError, match="has not started"):
            run(session, folder, rovio_active_camera_indices="1")


def test_folders_without_calibration_or_imu(tmp_path: Path) -> None:
    folder = write_folder(make_content(), tmp_path / "images")
    with Session() as session:
        (folder / "mav0" / "cam0" / "sensor.yaml").rename(tmp_path / "sensor.yaml")
        with pytest.raises(MapError, match="there is no calibration"):
            run(session, folder)
        (tmp_path / "sensor.yaml").rename(folder / "mav0" / "cam0" / "sensor.yaml")
        (folder / "mav0" / "imu0").rename(tmp_path / "imu0")
        with pytest.raises(UserError, match="odometry needs an IMU"):
            run(session, folder)


@pytest.mark.slow
@pytest.mark.parametrize(("cameras", "bar_m"), [("", 0.008), ("0", 0.010)])
def test_real_images(tmp_path: Path, cameras: str, bar_m: float) -> None:
    folder = shared_data("euroc_mh01_10s")
    truth = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    with Session() as session:
        report = run(
            session, folder, rovio_active_camera_indices=cameras, save_map_folder=tmp_path / "map",
            map_builder_save_image_as_resources=True,
        )  # fmt: skip
        assert report.failure == ""
        assert report.missions == 1
        evaluated = session.run("evaluate_trajectory", ground_truth=truth)
        assert evaluated.ape_m.rmse <= bar_m
        images = list((tmp_path / "map" / "resources" / "raw_images").iterdir())
        assert len(images) == report.vertices * (1 if cameras else 2)
        assert consistency.check_consistency(load_map(tmp_path / "map")[0]).failure == ""
        assert np.all(session.vi_map.binary_descriptor_size == 64)


def test_the_viewer_follows(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from maplab_plugins.visualization.following import Following

    from maplab_py.viewer.building import Subject
    from maplab_py.viewer.display.viewer import Viewer

    followed: list[tuple[int, int]] = []
    colourings: list[str] = []
    really_follow = Viewer.follow

    def follow(viewer: Viewer, subject: Subject) -> None:
        followed.append((len(subject.vi_map.vertices), len(subject.vi_map.landmarks)))
        colourings.append(subject.options.landmark_colouring)
        really_follow(viewer, subject)
        if len(followed) == 3:  # as a user in the page
            really_follow(
                viewer, subject.replace(options=subject.options.with_colouring("quality"))
            )

    monkeypatch.setattr(Viewer, "pages", property(lambda _: 1))
    monkeypatch.setattr(Viewer, "follow", follow)
    with Session() as session:
        session.run("set", "--viewer_port=0")
        report = run(session, walk, rovioli_visualize_map=True, map_publish_interval_s=0.0)
        assert session.watchers.find("viewer", Following) is not None
    vertices = [count for count, _ in followed]
    assert vertices == sorted(vertices)
    assert vertices[0] == 2
    assert vertices[-1] == report.vertices
    assert followed[-1][1] > 100
    assert colourings == 3 * ["height"] + (len(colourings) - 3) * ["quality"]
