"""A model that pycolmap makes of four of five recorded images: imported, aligned, and localised in."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from maplab_py.console.session.session import Session
from maplab_py.geometry import alignment, interpolation, se3
from maplab_py.interop.calibrations.parts import read_entry
from maplab_py.interop.colmap.features import with_images
from maplab_py.interop.colmap.importing import import_colmap
from maplab_py.interop.colmap.options import ColmapImportOptions
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.vimap import BaseFrames, Frames, Missions, MissionSensor, Vertices, VIMap, random_ids
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.descriptors import FeatureType
from tests.support.data import shared_data

RECONSTRUCT = Path(__file__).with_name("reconstruct.py")
CENTRES = """
import json, sys, pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
print(json.dumps(sorted([i.name, list(i.projection_center())] for i in model.images.values())))
"""
CAMERA = "euroc_v101_keyframes/mav0/cam0"
TRUTH = "euroc_imu/V101.gt.csv"
pytestmark = pytest.mark.slow


def ate_m(p_A: np.ndarray, p_B: np.ndarray) -> float:
    T_A_B, scale = alignment.umeyama(p_A, p_B, with_scale=True)
    error = se3.transform(T_A_B, scale * p_B) - p_A
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


@dataclasses.dataclass(frozen=True)
class Model:
    """A model of four of five images."""

    folder: Path  # with the model 0 and database.db
    images: Path
    held_out: list[str]
    centres: list[tuple[str, list[float]]]  # of the registered images, in W


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Model:
    images = shared_data(f"{CAMERA}/data")
    names = sorted(path.name for path in images.glob("*.jpg"))
    held_out = names[2::5]
    folder = tmp_path_factory.mktemp("model")
    used = [name for name in names if name not in held_out]
    program = [sys.executable, str(RECONSTRUCT), str(images), str(folder), *used]
    subprocess.run(program, check=True, capture_output=True)
    done = subprocess.run(
        [sys.executable, "-c", CENTRES, str(folder / "0")],
        check=True,
        capture_output=True,
        text=True,
    )
    return Model(folder, images, held_out, json.loads(done.stdout))


def test_a_reconstruction_of_recorded_images(model: Model) -> None:
    truth_file = shared_data(TRUTH)
    options = ColmapImportOptions(align_to=str(truth_file), images=str(model.images))
    database = model.folder / "database.db"
    vi_map, report = import_colmap(model.folder / "0", options, database=database)
    times_ns = np.array([int(Path(name).stem) for name, _ in model.centres])
    assert np.array_equal(vi_map.vertices.timestamp_ns, times_ns)
    assert report.images_as_resources == len(model.centres) >= 36
    assert not check_consistency(vi_map).errors
    assert not vi_map.missions.sensor_id[0, MissionSensor.IMU].any()
    assert set(vi_map.feature_type.tolist()) == {int(FeatureType.SIFT)}
    truth = read_trajectory(truth_file)
    T_G_I, valid = interpolation.interpolate_poses(truth.times_ns, truth.T_R_B, times_ns)
    p_G = T_G_I[valid, 4:]
    of_model = ate_m(p_G, np.array([centre for _, centre in model.centres])[valid])
    error = vi_map.T_G_I[valid, 4:] - p_G
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) == pytest.approx(of_model, abs=1e-6)
    assert of_model < 0.1


def camera_truth() -> Trajectory:
    """Return the true poses of the left camera."""
    truth = read_trajectory(shared_data(TRUTH))
    T_B_C = read_entry(shared_data(f"{CAMERA}/sensor.yaml")).pose("T_BS")
    return dataclasses.replace(truth, T_R_B=se3.compose(truth.T_R_B, T_B_C))


def write_tum(path: Path, trajectory: Trajectory) -> Path:
    rows = [
        f"{time_ns // 10**9}.{time_ns % 10**9:09d} "
        + " ".join(f"{value:.9f}" for value in [*pose[4:], *pose[:4]])
        for time_ns, pose in zip(
            trajectory.times_ns.tolist(), trajectory.T_R_B.tolist(), strict=True
        )
    ]
    path.write_text("\n".join(rows) + "\n")
    return path


def images_alone(vi_map: VIMap, images: Path, names: list[str], truth: Trajectory) -> VIMap:
    """Return a map of images without features; of the truth only the attitude is used later."""
    times_ns = np.array([int(Path(name).stem) for name in names])
    T_G_C, valid = interpolation.interpolate_poses(truth.times_ns, truth.T_R_B, times_ns)
    assert valid.all()
    count, rng = len(names), np.random.default_rng(0)
    result = VIMap(
        sensors=vi_map.sensors,
        missions=Missions.filled(
            1,
            id=random_ids(1, rng),
            baseframe=[0],
            root_vertex=[0],
            backbone=vi_map.missions.backbone[:1],
            sensor_id=vi_map.missions.sensor_id[:1],
        ),
        baseframes=BaseFrames.filled(1, id=random_ids(1, rng), is_known=[True]),
        vertices=Vertices.filled(
            count,
            id=random_ids(count, rng),
            mission=np.zeros(count),
            T_M_I=T_G_C,
            timestamp_ns=times_ns,
            nframe_id=random_ids(count, rng),
        ),
        frames=Frames.filled(
            count, id=random_ids(count, rng), vertex=np.arange(count), timestamp_ns=times_ns
        ),
    )
    return with_images(result, names, images, link=False)[0]


def test_the_other_images_are_localised_in_it(model: Model, tmp_path: Path) -> None:
    truth = camera_truth()
    file = write_tum(tmp_path / "camera.tum", truth)
    with Session() as session:
        session.run(
            "import_colmap",
            colmap_folder=model.folder / "0",
            database=model.folder / "database.db",
            images=str(model.images),
            align_to=str(file),
            map_key="model",
        )
        queries = images_alone(session.vi_map, model.images, model.held_out, truth)
        for line in ("itl", "elq", "lc --lc_feature_type=SIFT", "kfh"):
            name, *flags = line.split()
            values = dict(flag.removeprefix("--").split("=") for flag in flags)
            session.run(name, **values)
        summary = tmp_path / "summary"
        session.run(
            "generate_summary_map_and_save_to_disk",
            summary_map_save_path=summary,
            lc_feature_type="SIFT",
        )
        session.run("undo")  # kfh: the full map keeps all its vertices
        session.maps.add("queries", queries)
        session.maps.select("queries")
        session.run("extract_features", feature_type="sift", max_features=1500)
        results = []
        for where, flags in (("model", {"lc_feature_type": "SIFT"}), (summary, {})):
            report = session.run(
                "localize",
                localization_map=str(where),
                ground_truth=file,
                localization_csv=tmp_path / f"{Path(where).name}.csv",
                **flags,
            )
            results.append(report)
    for report in results:
        assert report.queries == len(model.held_out) == 10
    for where in ("model", "summary"):
        answers = np.genfromtxt(
            tmp_path / f"{where}.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
        )
        close = (answers["position_error_m"] < 0.1) & (answers["orientation_error_deg"] < 2.0)
        assert np.count_nonzero(close) >= 8, where
