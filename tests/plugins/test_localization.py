"""Localisation in summary maps, of sessions and of rovioli, through the console."""

import json
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.evidence import read_evidence
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.console.session.session import Session
from maplab_py.errors import FlagError, MapError, UserError
from maplab_py.frontend.reports import MappingReport
from maplab_py.interop.trajectories import Trajectory, write_euroc
from maplab_py.simulation.scenario import SessionOptions
from maplab_py.storage.native import save_map
from maplab_py.storage.summary_map import SummaryMap, write_summary_map
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.display.viewer import Viewer
from tests.frontend.localization.places import Place, place_of
from tests.simulation.small import simulated

LENIENT = {"elq_min_observers": 3, "elq_min_observation_angle_deg": 1.0}


@pytest.fixture
def session(tmp_path: Path) -> Session:
    session = Session()
    data = simulated()
    data.truth.save(tmp_path / "truth.npz")
    session.maps.add("query", data.maps[0])
    session.maps.add("map", data.maps[0])
    session.run("select_map", "map")
    session.run("elq", **LENIENT)
    return session


@pytest.mark.parametrize("kind", ["key", "summary", "folder"])
def test_a_session_is_found_in_its_own_map(session: Session, tmp_path: Path, kind: str) -> None:
    place = {"key": "map", "summary": str(tmp_path / "summary"), "folder": str(tmp_path / "full")}
    if kind == "summary":
        written = session.run("summary_map", summary_map_save_path=tmp_path / "summary")
        shown = session.run("print_summary_map", tmp_path / "summary")
        assert shown.landmarks == written.landmarks
        assert shown.has_projection
        assert shown.cameras == 1
    if kind == "folder":
        session.run("save", map_folder=tmp_path / "full")
    session.run("select_map", "query")
    before = session.vi_map
    table, report_file = tmp_path / "poses.csv", tmp_path / "report.json"
    report = session.run(
        "localize",
        localization_map=place[kind],
        truth=tmp_path / "truth.npz",
        localization_csv=table,
        localization_json=report_file,
    )
    assert session.vi_map is before
    assert report.map_kind == ("summary" if kind == "summary" else "full")
    assert report.success_share > 0.9
    assert report.wrong == 0
    header, *lines = table.read_text().splitlines()
    assert len(lines) == len(before.vertices)
    assert all(len(line.split(",")) == len(header.split(",")) for line in lines)
    assert json.loads(report_file.read_text())["success"] == report.success


def test_other_missions_of_the_same_map_are_searched(session: Session) -> None:
    with pytest.raises(UserError, match="--map_mission"):
        session.run("localize")
    with pytest.raises(UserError, match="neither a map in memory"):
        session.run("localize", localization_map="nowhere")


def test_a_file_is_not_overwritten_unasked(session: Session, tmp_path: Path) -> None:
    session.run("summary_map", summary_map_save_path=tmp_path / "s")
    with pytest.raises(UserError, match="overwrite"):
        session.run("summary_map", summary_map_save_path=tmp_path / "s")
    with pytest.raises(UserError, match="--summary_map_save_path"):
        session.run("summary_map")
    table = tmp_path / "poses.csv"
    table.write_text("mine")
    with pytest.raises(UserError, match="overwrite"):
        session.run("localize", localization_map="map", localization_csv=table)
    assert table.read_text() == "mine"


def walk() -> Place:
    """A map and a session of 12 s in it; a single camera may take 4 s to start."""
    return place_of(SessionOptions(duration_s=12.0, turns=0.7, start_turn=0.2, height_m=1.7))


def walk_summary() -> SummaryMap:
    return make_summary_map(walk().vi_map, SummaryMapOptions())


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the map, its summary map, the recording, and the truth of both in G."""
    folder, where = tmp_path_factory.mktemp("localisation"), walk()
    save_map(where.vi_map, folder / "map")
    save_map(where.query, folder / "query")
    write_summary_map(walk_summary(), folder / "summary")
    write_euroc(Trajectory(where.times_ns, where.T_G_I), folder / "truth.csv")
    write_euroc(
        Trajectory(where.vi_map.vertices.timestamp_ns, where.vi_map.T_G_I), folder / "map_truth.csv"
    )
    return folder


def localized(session: Session, folders: Path, **flags: object) -> MappingReport:
    report = session.run(
        "rovioli", datasource_folder=folders / "query", rovioli_run_map_builder=False, **flags
    )
    assert isinstance(report, MappingReport)
    return report


def test_poses_in_the_map_are_written_and_evaluated(folders: Path, tmp_path: Path) -> None:
    file = tmp_path / "vil.csv"
    with Session() as session:
        report = localized(
            session, folders, vio_localization_map_folder=folders / "summary",
            export_localized_poses_to_csv=file,
        )  # fmt: skip
        said = report.localization
        assert said is not None
        assert said.mode == "vil"
        assert said.starts == 1
        assert said.csv_file == file
        assert 0.5 < said.localized_share <= 1.0
        assert any(stage.stage == "localise" for stage in report.frame_times)
        assert len(file.read_text().splitlines()) == 1 + report.estimated_frames
        evaluation = session.run(
            "evaluate_localization", localization_csv=str(file), ground_truth=folders / "truth.csv"
        )
        errors = evaluation.files[0]
        assert evaluation.failure == ""
        assert errors.median_m < 0.05
        assert errors.localized_share > 0.8
        assert 0.0 < errors.first_localized_s < 5.0
        aligned = session.run(
            "evaluate_localization", localization_csv=f"{file}, {file}",
            ground_truth=folders / "truth.csv", map_folder=folders / "map",
            map_ground_truth=folders / "map_truth.csv",
        )  # fmt: skip
        assert len(aligned.files) == 2
        assert aligned.files[0].median_m == pytest.approx(errors.median_m, abs=1e-3)
        with pytest.raises(UserError, match=r"vil.csv exists already"):
            localized(
                session, folders, vio_localization_map_folder=folders / "summary",
                export_localized_poses_to_csv=file,
            )  # fmt: skip


def test_what_a_recording_saw_of_the_map_is_noted_in_it(folders: Path, tmp_path: Path) -> None:
    anchored = walk().vi_map
    known = np.ones(len(anchored.baseframes), dtype=np.bool_)
    save_map(
        anchored.replace(baseframes=anchored.baseframes.replace(is_known=known)), tmp_path / "map"
    )
    flags = {"datasource_folder": folders / "query", "gather_evidence": True}
    with Session() as session:
        with pytest.raises(UserError, match="--gather_evidence wants the folder of a map"):
            session.run("rovioli", **flags, vio_localization_map_folder=folders / "summary")
        session.run("rovioli", **flags, vio_localization_map_folder=tmp_path / "map")
        session.run("load", map_folder=tmp_path / "map", map_key="map")
        recent = read_evidence(session.vi_map)["recent"][:, -1]
        assert np.count_nonzero(recent["predicted"]) > 100
        assert 0.5 < (recent["matched"] > 0)[recent["predicted"] > 0].mean() <= 1.0
        assert len(session.vi_map.missions) == len(anchored.missions)


def test_wrong_input_is_told_in_one_line(folders: Path, tmp_path: Path) -> None:
    with Session() as session:
        for flags, error, message in (
            ({"vio_localization_map_folder": tmp_path}, UserError, "neither a map folder nor"),
            ({"export_localized_poses_to_csv": tmp_path / "x.csv"}, FlagError, "needs --vio_loc"),
            (
                {
                    "vio_localization_map_folder": folders / "summary",
                    "vil_map_tilt_sigma_deg": 0.0,
                },
                FlagError,
                "vil_map_tilt_sigma_deg=0: must be above 0",
            ),
        ):
            with pytest.raises(error, match=message) as told:
                localized(session, folders, **flags)
            assert "\n" not in str(told.value)
        damaged = tmp_path / "damaged" / "localization_summary_map"
        damaged.parent.mkdir()
        content = (folders / "summary" / "localization_summary_map").read_bytes()
        damaged.write_bytes(content[: len(content) // 2])
        with pytest.raises(MapError, match="localization_summary_map"):
            localized(session, folders, vio_localization_map_folder=damaged.parent)


def test_evaluation_tells_what_is_missing(folders: Path, tmp_path: Path) -> None:
    late = Trajectory(walk().times_ns + 10**12, walk().T_G_I)
    write_euroc(late, tmp_path / "late.csv")
    with Session() as session:
        with pytest.raises(UserError, match="--localization_csv=FILE"):
            session.run("evaluate_localization", ground_truth=folders / "truth.csv")
        with pytest.raises(Exception, match="no frame lies in the time span"):
            session.run(
                "evaluate_localization", localization_csv=str(folders / "truth.csv"),
                ground_truth=tmp_path / "late.csv",
            )  # fmt: skip
        with pytest.raises(Exception, match="fewer than 3 vertices"):
            session.run(
                "evaluate_localization", localization_csv=str(folders / "truth.csv"),
                ground_truth=folders / "truth.csv", map_folder=folders / "map",
            )  # fmt: skip


def test_the_viewer_shows_the_map_both_paths_and_the_matches(
    folders: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Subject] = []
    monkeypatch.setattr(Viewer, "pages", property(lambda _: 1))
    monkeypatch.setattr(Viewer, "follow", lambda _, subject: shown.append(subject))
    with Session() as session:
        session.run("set", "--viewer_port=0")
        session.run(
            "rovioli", datasource_folder=folders / "query", map_publish_interval_s=0.0,
            vio_localization_map_folder=folders / "summary", rovioli_visualize_map=True,
        )  # fmt: skip
    assert shown[0].localized is None  # not localised yet
    subject = shown[-1]
    run = subject.localized
    assert run is not None
    where = walk()
    np.testing.assert_array_equal(run.p_G, walk_summary().p_G)
    rows = np.searchsorted(where.times_ns, subject.vi_map.vertices.timestamp_ns)
    error_m = np.linalg.norm(subject.vi_map.T_G_I[:, 4:] - where.T_G_I[rows, 4:], axis=1)
    assert np.median(error_m) < 0.1  # the map of the run is drawn in G
    nearest = np.linalg.norm(run.p_G_I[:, None] - where.T_G_I[:, 4:], axis=2).min(axis=1)
    assert np.nanmax(nearest) < 0.3
    assert len(run.rays_G) >= 5
    scene = build_scene(subject)
    drawn = {layer.name: layer.drawn for layer in scene.layers}
    assert drawn["map_landmarks"] == len(run.p_G)
    assert drawn["localized_path"] == len(run.p_G_I) - 1
    assert drawn["map_matches"] == len(run.rays_G)
    assert drawn["trajectories"] > 0
    outline = scene.extent.outline
    assert np.all(outline.max(axis=0) >= np.percentile(run.p_G, 90.0, axis=0))
