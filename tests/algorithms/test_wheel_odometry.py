"""Wheel odometry: files, edges of a mission, their scale, and bad input."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.external_poses.options import WheelOptions
from maplab_py.algorithms.external_poses.wheels import attach_wheels
from maplab_py.algorithms.relaxation.map_edges import trajectory_edges
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.console.session.session import Session
from maplab_py.errors import FlagError, MaplabError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.wheel_odometry import accumulated, read_wheel_odometry
from maplab_py.sensors import Extrinsics, OtherSensor
from maplab_py.sensors.wheels import wheel_scale, with_wheel_scale
from maplab_py.simulation import evaluation, scenario_file
from maplab_py.simulation.session import wheel_velocities, write_wheel_velocities
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import Backbone, MissionSensor, TransformationKind, VIMap, merge, to_hex
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.vertex_removal import join_transformation_edges
from tests.support.scene import Scene
from tests.vimap.builders import IMU_ID, STEP_NS, walk_map

WHEELS = int(TransformationKind.WHEEL_ODOMETRY)
ARM = "0.1,-0.2,-0.3"
T_I_S = se3.make(so3.exp([0.0, 0.0, 0.4]), np.array([0.1, -0.2, -0.3]))
FLAGS = {
    "wheel_position_m": ARM,
    "wheel_orientation_xyzw": ",".join(repr(float(x)) for x in T_I_S[:4]),
}
VERTICES, START_NS = 12, 1_700_000_000_000_000_000


def driven(scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and poses T_O_S of the wheels of `walk_map`, four for each step."""
    vi_map = walk_map(VERTICES, first_ns=START_NS)
    T_M_S = se3.compose(vi_map.vertices.T_M_I, T_I_S)
    step = se3.log(se3.relative(T_M_S[:-1], T_M_S[1:]))
    quarters = np.repeat(0.25 * step, 4, axis=0)
    T_O_S = np.concatenate([se3.identity(1), accumulated(se3.exp(quarters))])
    T_O_S[:, 4:] *= scale
    times_ns = vi_map.vertices.timestamp_ns[0] + STEP_NS // 4 * np.arange(len(T_O_S))
    return times_ns, T_O_S


def write(path: Path, header: str, times_ns: Any, values: Any) -> Path:
    stamps = [f"{t // 10**9}.{t % 10**9:09d}" for t in np.asarray(times_ns).tolist()]
    rows = [
        ",".join([t, *(repr(float(x)) for x in row)]) for t, row in zip(stamps, values, strict=True)
    ]
    path.write_text("\n".join([f"timestamp [s],{header}", *rows]) + "\n")
    return path


def write_poses(path: Path, scale: float = 1.0) -> Path:
    times_ns, T = driven(scale)
    return write(path, "x,y,z,qx,qy,qz,qw", times_ns, np.concatenate([T[:, 4:], T[:, :4]], axis=1))


def wheel_edges(vi_map: VIMap) -> Any:
    table = vi_map.transformation_edges
    return table.take(np.flatnonzero(table.kind == WHEELS))


@pytest.fixture
def session() -> Session:
    session = Session()
    session.maps.add("walk", walk_map(VERTICES, first_ns=START_NS))
    return session


def test_products_are_those_of_one_pose_after_the_other() -> None:
    rng = np.random.default_rng(3)
    T = se3.make(so3.exp(rng.normal(0, 1, (13, 3))), rng.normal(0, 1, (13, 3)))
    product = se3.identity()
    for row, each in zip(accumulated(T), T, strict=True):
        product = se3.compose(product, each)
        np.testing.assert_allclose(so3.log(se3.relative(product, row)[:4]), 0.0, atol=1e-12)
        np.testing.assert_allclose(row[4:], product[4:], atol=1e-12)


def test_poses_motions_and_velocities_are_the_same_drive(tmp_path: Path) -> None:
    times_ns, T = driven()
    steps = np.concatenate([se3.identity(1), se3.relative(T[:-1], T[1:])])
    # velocities that change linearly between rows, as they are integrated
    planar = np.cumsum(np.full((len(T), 3), [0.03, 0.01, 0.02]), axis=0)
    drive = write(tmp_path / "v.csv", "vx,vy,wz", times_ns, planar)
    tracks = [
        read_wheel_odometry(write_poses(tmp_path / "p.csv")),
        read_wheel_odometry(
            write(
                tmp_path / "m.csv",
                "dx,dy,dz,dqx,dqy,dqz,dqw",
                times_ns,
                np.concatenate([steps[:, 4:], steps[:, :4]], axis=1),
            )
        ),
        read_wheel_odometry(drive),
    ]
    assert [track.kind for track in tracks] == ["poses", "motions", "velocities"]
    assert [track.is_planar for track in tracks] == [False, False, True]
    np.testing.assert_allclose(tracks[0].T_O_S[:, 4:], tracks[1].T_O_S[:, 4:], atol=1e-9)
    seconds = (times_ns - times_ns[0]) * 1e-9
    velocities = tracks[2].T_O_S
    assert np.all(velocities[:, 6] == 0.0)
    heading = so3.log(velocities[:, :4])[:, 2]
    wanted = 0.02 * seconds * (1.0 + 0.5 * seconds / seconds[1])
    np.testing.assert_allclose(heading, wanted, atol=1e-12)
    # the same drive as poses and motions of a plane
    p = np.column_stack([velocities[:, 4:6], heading])
    again = read_wheel_odometry(write(tmp_path / "xy.csv", "x,y,theta", times_ns, p))
    np.testing.assert_allclose(again.T_O_S, velocities, atol=1e-12)
    only_forwards = write(tmp_path / "vx.csv", "linear_x,angular_z", times_ns, planar[:, [0, 2]])
    assert read_wheel_odometry(only_forwards).kind == "velocities"


def test_edges_their_sensor_and_undo(session: Session, tmp_path: Path) -> None:
    before, path = session.vi_map, write_poses(tmp_path / "wheels.csv")
    report: Any = session.run("import_wheel_odometry", wheel_file=path, **FLAGS)
    assert (report.kind, report.added, report.without_edge) == ("poses", VERTICES - 1, 0)
    assert report.distance_ratio == pytest.approx(1.0, abs=1e-6)
    after, edges = session.vi_map, wheel_edges(session.vi_map)
    T_M_S = se3.compose(before.vertices.T_M_I, T_I_S)
    np.testing.assert_allclose(edges.T_A_B, se3.relative(T_M_S[:-1], T_M_S[1:]), atol=1e-9)
    sensor_id = to_hex(after.missions.sensor_id[0, MissionSensor.WHEEL_ODOMETRY])
    assert sensor_id == report.sensor_id
    np.testing.assert_allclose(after.sensors.T_I_S(IMU_ID, sensor_id), T_I_S, atol=1e-12)
    assert check_consistency(after).errors == check_consistency(before).errors
    with pytest.raises(UserError, match="--wheel_replace"):
        session.run("import_wheel_odometry", wheel_file=path, **FLAGS)
    session.run(
        "import_wheel_odometry", wheel_file=path, **FLAGS, wheel_replace=True, wheel_yaw_sigma_deg=2
    )
    again = wheel_edges(session.vi_map)
    assert len(again) == len(edges)
    assert np.all(again.covariance[:, 5, 5] > edges.covariance[:, 5, 5])
    assert len(session.vi_map.sensors.sensors) == len(after.sensors.sensors)
    session.run("undo")
    assert session.vi_map is after
    session.run("undo")
    assert session.vi_map is before


def test_files_merging_and_keyframes_keep_wheels(session: Session, tmp_path: Path) -> None:
    session.run("import_wheel_odometry", wheel_file=write_poses(tmp_path / "w.csv"), **FLAGS)
    vi_map = session.vi_map
    sensor_id = to_hex(vi_map.missions.sensor_id[0, MissionSensor.WHEEL_ODOMETRY])
    scaled = vi_map.replace(sensors=with_wheel_scale(vi_map.sensors, sensor_id, 1.0123456789))
    session.maps.add("scaled", scaled)
    session.run("save", map_folder=tmp_path / "map")
    session.run("load", map_folder=tmp_path / "map", map_key="again")
    again = session.vi_map
    assert wheel_scale(again.sensors, sensor_id) == 1.0123456789
    for name in ("id", "kind", "T_A_B", "covariance", "sensor_id"):
        np.testing.assert_array_equal(
            getattr(wheel_edges(again), name), getattr(wheel_edges(scaled), name)
        )
    # another map with the same sensor at another scale: both scales survive
    other = walk_map(VERTICES, seed=1, first_ns=START_NS + 10**12)
    times_ns, T = driven()
    shifted = write(
        tmp_path / "later.csv",
        "x,y,z,qx,qy,qz,qw",
        times_ns + 10**12,
        np.concatenate([T[:, 4:], T[:, :4]], axis=1),
    )
    other_sensors = dataclasses.replace(
        other.sensors,
        sensors={**other.sensors.sensors, sensor_id: vi_map.sensors.sensors[sensor_id]},
        extrinsics={**other.sensors.extrinsics, sensor_id: Extrinsics(IMU_ID, T_I_S)},
    )
    other, _ = attach_wheels(
        other.replace(sensors=other_sensors),
        0,
        read_wheel_odometry(shifted),
        WheelOptions(sensor_id=sensor_id),
    )
    merged = merge.merge_maps(scaled, other)[0]
    edges = wheel_edges(merged)
    assert len(edges) == 2 * (VERTICES - 1)
    scales = {wheel_scale(merged.sensors, to_hex(words)) for words in edges.sensor_id}
    assert scales == {1.0, 1.0123456789}
    # joined over removed vertices, edges are those of the wheels over two steps
    kept = np.arange(VERTICES) % 2 == 0
    joined, broken = join_transformation_edges(scaled, kept)
    pairs, T_M_S = wheel_edges(joined), se3.compose(scaled.vertices.T_M_I, T_I_S)
    assert broken == 0
    first, second = pairs.from_vertex, pairs.to_vertex
    assert np.all(second - first == 2)
    np.testing.assert_allclose(pairs.T_A_B, se3.relative(T_M_S[first], T_M_S[second]), atol=1e-9)


def test_scales_that_are_no_positive_numbers_are_found(session: Session, tmp_path: Path) -> None:
    session.run("import_wheel_odometry", wheel_file=write_poses(tmp_path / "w.csv"), **FLAGS)
    vi_map = session.vi_map
    sensor_id = to_hex(vi_map.missions.sensor_id[0, MissionSensor.WHEEL_ODOMETRY])
    wrong = vi_map.replace(sensors=with_wheel_scale(vi_map.sensors, sensor_id, -1.0))
    more = set(check_consistency(wrong).errors) - set(check_consistency(vi_map).errors)
    assert [violation.rule for violation in more] == [
        "wheel sensor whose scale in sensors.yaml is no positive number"
    ]


def test_relaxation_does_not_take_wheels_for_the_body(session: Session, tmp_path: Path) -> None:
    vi_map = session.vi_map
    missions = vi_map.missions.replace(backbone=np.array([Backbone.ODOMETRY]))
    vi_map = vi_map.replace(missions=missions)
    track = read_wheel_odometry(write_poses(tmp_path / "w.csv", scale=1.1))
    options = WheelOptions(position_m=ARM, orientation_xyzw=FLAGS["wheel_orientation_xyzw"])
    with_both, _ = attach_wheels(vi_map, 0, track, options)
    wanted, found = (trajectory_edges(m, RelaxationOptions()) for m in (vi_map, with_both))
    np.testing.assert_array_equal(found.T_A_B, wanted.T_A_B)
    np.testing.assert_array_equal(found.sqrt_information, wanted.sqrt_information)


def test_a_sensor_of_the_map_brings_mounting_and_covariance(tmp_path: Path) -> None:
    vi_map, sensor_id = walk_map(VERTICES, first_ns=START_NS), "5" * 32
    C = np.diag([1e-4, 2e-4, 3e-4, 4e-6, 5e-6, 6e-6])
    keys = {
        "id": sensor_id,
        "sensor_type": "WHEEL_ODOMETRY",
        "T_St_Stp1_fixed_covariance": {"rows": 6, "cols": 6, "data": C.tolist()},
        "wheel_scale": 1.1,
    }
    sensors = dataclasses.replace(
        vi_map.sensors,
        sensors={
            **vi_map.sensors.sensors,
            sensor_id: OtherSensor(sensor_id, "WHEEL_ODOMETRY", keys),
        },
        extrinsics={**vi_map.sensors.extrinsics, sensor_id: Extrinsics(IMU_ID, T_I_S)},
    )
    vi_map = vi_map.replace(sensors=sensors)
    track = read_wheel_odometry(write_poses(tmp_path / "w.csv", scale=1.1))
    result, report = attach_wheels(vi_map, 0, track, WheelOptions(sensor_id=sensor_id))
    np.testing.assert_array_equal(wheel_edges(result).covariance[0], C)
    assert report.distance_ratio == pytest.approx(1.0, abs=1e-6)
    again, _ = attach_wheels(result, 0, track, WheelOptions(sensor_id=sensor_id, replace=True))
    assert again.sensors.sensors[sensor_id] is vi_map.sensors.sensors[sensor_id]
    with pytest.raises(UserError, match="no WHEEL_ODOMETRY sensor"):
        attach_wheels(vi_map, 0, track, WheelOptions(sensor_id=IMU_ID))


@pytest.mark.parametrize(
    ("header", "change", "message"),
    [
        ("a,b,c,d,e,f,g", lambda t, v: (t, v), "no wheel odometry: a header is wanted"),
        ("x,y,z,qx,qy,qz", lambda t, v: (t, v[:, :6]), "no wheel odometry: a header is wanted"),
        ("x,y,z,qx,qy,qz,qw", lambda t, v: (t[::-1], v), "is not after that of the row before"),
        ("x,y,z,qx,qy,qz,qw", lambda t, v: (t[:1], v[:1]), "needs two rows"),
        ("x,y,z,qx,qy,qz,qw", lambda t, v: (t, v * 2), "quaternion has the length"),
        ("x,y,z,qx,qy,qz,qw", lambda t, v: (t + 10**12, v), "--wheel_time_offset_s"),
        ("x,y,z,qx,qy,qz,qw", lambda t, v: (t // 10**9, v), "is not after that of the row before"),
        ("x,y,z,qx,qy,qz,qw", lambda t, v: (t, v * ([1e3] * 3 + [1] * 4)), "metres, radians"),
        ("vx,vy,wz", lambda t, v: (t, v[:, :3] * 0 + [0.3, 0, 45.0]), "angles in radians"),
        ("vx,vy,wz", lambda t, v: (t, v[:, :3] * np.nan), "is not a finite number"),
    ],
)
def test_wrong_files_are_refused(
    header: str, change: Any, message: str, session: Session, tmp_path: Path
) -> None:
    before, (times_ns, T) = session.vi_map, driven()
    values = np.concatenate([T[:, 4:], T[:, :4]], axis=1)
    path = write(tmp_path / "w.csv", header, *change(times_ns, values))
    with pytest.raises(MaplabError, match=message) as caught:
        session.run("import_wheel_odometry", wheel_file=path, **FLAGS)
    assert "\n" not in str(caught.value)
    assert "w.csv" in str(caught.value)
    assert session.vi_map is before


@pytest.mark.parametrize(
    "flags",
    [
        {"wheel_position_m": "1,2"},
        {"wheel_orientation_xyzw": "0,0,0,2"},
        {"wheel_orientation_xyzw": "0,0,1"},
        {"wheel_time_offset_s": float("inf")},
    ],
)
def test_wrong_flags_are_refused(flags: dict[str, Any], session: Session, tmp_path: Path) -> None:
    before, path = session.vi_map, write_poses(tmp_path / "w.csv")
    with pytest.raises(FlagError, match=next(iter(flags))):
        session.run("import_wheel_odometry", wheel_file=path, **flags)
    assert session.vi_map is before


def with_wheels(true: VIMap, scale: float, tmp_path: Path) -> tuple[VIMap, str]:
    """Return a map with exact edges of wheels of another scale, and their sensor's id."""
    T_M_S = se3.compose(true.vertices.T_M_I, T_I_S)
    T_M_S[:, 4:] *= scale
    values = np.concatenate([T_M_S[:, 4:], T_M_S[:, :4]], axis=1)
    path = write(tmp_path / "w.csv", "x,y,z,qx,qy,qz,qw", true.vertices.timestamp_ns, values)
    options = WheelOptions(
        position_m=ARM, orientation_xyzw=FLAGS["wheel_orientation_xyzw"], position_sigma_m=1e-3
    )
    result, report = attach_wheels(true, 0, read_wheel_odometry(path), options)
    return result, report.sensor_id


@pytest.mark.parametrize("fix_extrinsics", [True, False])
def test_exact_wheels_give_their_scale_and_a_known_scale_is_used(
    fix_extrinsics: bool, tmp_path: Path
) -> None:
    true = Scene(vertices=16, interval_s=0.25, landmarks=250).make()
    vi_map, sensor_id = with_wheels(true, 1.02, tmp_path)
    options = VIOptimizationOptions(
        include_wheel_odometry=True,
        fix_wheel_scale=False,
        fix_wheel_odometry_extrinsics=fix_extrinsics,
        num_iterations=50,
        function_tolerance=1e-14,
    )
    result, report = optimize(vi_map, options)
    assert wheel_scale(result.sensors, sensor_id) == pytest.approx(1.02, abs=1e-5)
    names = [row.parameter for row in report.calibration]
    assert sum("scale, reported / driven" in name for name in names) == 1
    assert all(row.sigma > 0.0 for row in report.calibration)
    known = vi_map.replace(sensors=with_wheel_scale(vi_map.sensors, sensor_id, 1.02))
    kept, report = optimize(known, dataclasses.replace(options, fix_wheel_scale=True))
    assert wheel_scale(kept.sensors, sensor_id) == 1.02
    np.testing.assert_allclose(kept.T_G_I[:, 4:], true.T_G_I[:, 4:], atol=1e-5)
    assert report.cost_after == pytest.approx(0.0, abs=1e-6)


def test_wheels_of_unknown_scale_do_not_fix_the_scale_of_images(tmp_path: Path) -> None:
    vi_map, sensor_id = with_wheels(Scene(vertices=8, landmarks=100).make(), 1.3, tmp_path)
    options = VIOptimizationOptions(
        include_inertial=False, include_wheel_odometry=True, fix_wheel_scale=False
    )
    result, report = optimize(vi_map, options)
    assert report.gauge == "pose and scale of 1 cluster"
    assert wheel_scale(result.sensors, sensor_id) == pytest.approx(1.3, rel=0.01)
    assert optimize(vi_map, dataclasses.replace(options, fix_wheel_scale=True))[1].gauge == (
        "pose of 1 cluster"
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_simulated_wheels_give_their_scale_to_a_tenth_of_a_percent(
    seed: int, tmp_path: Path
) -> None:
    scenario = scenario_file.load_scenario("vehicle").with_seed(seed)
    data = simulate(scenario)
    recording = data.recordings[0].recording
    wheels = wheel_velocities(recording, scenario.other_sensors, np.random.default_rng(seed))
    write_wheel_velocities(wheels, tmp_path / "wheels.csv", overwrite=False)
    with Session() as session:
        session.maps.add("vehicle", data.maps[0])
        report: Any = session.run(
            "import_wheel_odometry",
            wheel_file=tmp_path / "wheels.csv",
            wheel_position_m="-0.2,0,-0.3",
            wheel_position_sigma_m=0.004,
            wheel_replace=True,
        )
        session.run(
            "optvi", ba_include_wheel_odometry=True, ba_fix_wheel_scale=False, ba_num_iterations=50
        )
        scale = wheel_scale(session.vi_map.sensors, report.sensor_id)
        assert abs(scale / 1.02 - 1.0) <= 0.001
        assert evaluation.evaluate_map(session.vi_map, data.truth).ate_m < 0.05
