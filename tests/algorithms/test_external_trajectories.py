"""Trajectories as absolute poses, odometry edges and missions, of good and of wrong files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.external_poses.alignment import robust_yaw_position
from maplab_py.console.session.session import Session
from maplab_py.errors import EstimationError, MapError, MaplabError, UserError
from maplab_py.geometry import interpolation, se3, so3
from maplab_py.interop.trajectories import Trajectory, read_kitti, write_euroc, write_tum
from maplab_py.vimap import TransformationKind, VIMap
from maplab_py.vimap.consistency import check_consistency
from tests.interop.small_map import RIG_ID, VERTICES, make_map

TURN = se3.make(so3.exp([0.0, 0.0, 0.7]), np.array([10.0, -5.0, 2.0]))


def flat_map() -> VIMap:
    """The small map with gravity along -z of G, as in every real map."""
    vi_map = make_map()
    level = se3.make(so3.exp([[0.0, 0.0, 0.3], [0.0, 0.0, -1.0]]), np.ones((2, 3)))
    missions = vi_map.missions.replace(root_vertex=np.array([0, VERTICES], dtype=np.int32))
    baseframes = vi_map.baseframes.replace(T_G_M=level)
    return vi_map.replace(baseframes=baseframes, missions=missions)


def truth(vi_map: VIMap, mission: int = 0, T_I_S: Any = None) -> Trajectory:
    """Poses of the vertices of a mission in another frame, at ten times their rate."""
    rows = np.flatnonzero(vi_map.vertices.mission == mission)
    stamps = vi_map.vertices.timestamp_ns[rows]
    times = np.linspace(0, int(stamps[-1] - stamps[0]), 10 * (len(rows) - 1) + 1)
    times_ns = stamps[0] + times.astype(np.int64)
    T_M_I = interpolation.interpolate_poses(stamps, vi_map.vertices.T_M_I[rows], times_ns)[0]
    T_R_S = se3.compose(se3.compose(TURN, T_M_I), se3.identity() if T_I_S is None else T_I_S)
    return Trajectory(times_ns, T_R_S)


@pytest.fixture
def session() -> Session:
    session = Session()
    session.maps.add("small", flat_map())
    return session


@pytest.mark.parametrize("form", ["tum", "euroc"])
def test_absolute_poses_and_the_base_frame(form: str, session: Session, tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    (write_tum if form == "tum" else write_euroc)(truth(session.vi_map), path)
    mission = session.vi_map.mission(0).id[:8]
    flags = {"trajectory_file": path, "map_mission": mission}
    report: Any = session.run("import_trajectory", **flags, position_sigma_m=0.02)
    assert (report.kind, report.added, report.without_pose) == ("absolute", VERTICES, 0)
    after = session.vi_map
    assert check_consistency(after).errors == check_consistency(flat_map()).errors
    np.testing.assert_allclose(after.T_G_M[0], TURN, atol=1e-6)
    measured = after.absolute_poses
    np.testing.assert_allclose(measured.T_G_S, after.T_G_I[measured.vertex], atol=1e-6)
    np.testing.assert_allclose(np.sqrt(measured.covariance[0, 0, 0]), 0.02)
    with pytest.raises(UserError, match="--replace"):
        session.run("import_trajectory", **flags)
    session.run("import_trajectory", **flags, replace=True, position_sigma_m=0.3)
    assert len(session.vi_map.absolute_poses) == VERTICES
    assert len(session.vi_map.sensors.sensors) == len(after.sensors.sensors)
    session.run("save", map_folder=tmp_path / "map")
    session.run("load", map_folder=tmp_path / "map", map_key="again")
    assert len(session.vi_map.absolute_poses) == VERTICES


def test_poses_of_a_camera_and_another_clock(session: Session, tmp_path: Path) -> None:
    vi_map, path = session.vi_map, tmp_path / "poses.txt"
    T_I_S = vi_map.sensors.T_I_S("a" * 32, RIG_ID)
    poses = truth(vi_map, 1, T_I_S)
    write_tum(Trajectory(poses.times_ns - 3_000_000_000, poses.T_R_B), path)
    mission = vi_map.mission(1).id[:8]
    flags = {"trajectory_file": path, "map_mission": mission, "sensor_id": RIG_ID}
    with pytest.raises(UserError, match="--time_offset_s"):
        session.run("import_trajectory", **flags)
    assert session.vi_map is vi_map
    session.run("import_trajectory", **flags, time_offset_s=3.0)
    np.testing.assert_allclose(session.vi_map.T_G_M[1], TURN, atol=1e-5)


def test_odometry_edges_are_the_motion(session: Session, tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    write_tum(truth(session.vi_map), path)
    flags = {
        "trajectory_file": path,
        "as": "odometry",
        "map_mission": session.vi_map.mission(0).id[:8],
    }
    report: Any = session.run("import_trajectory", **flags, position_sigma_m=0.1)
    assert (report.added, report.without_pose) == (VERTICES - 1, 0)
    edges, T = session.vi_map.transformation_edges, session.vi_map.vertices.T_M_I
    assert set(edges.kind.tolist()) == {int(TransformationKind.ODOMETRY)}
    expected = se3.relative(T[edges.from_vertex], T[edges.to_vertex])
    np.testing.assert_allclose(edges.T_A_B, expected, atol=1e-6)
    # half a second between vertices
    np.testing.assert_allclose(edges.covariance[:, 0, 0], 0.5 * 0.1**2)
    with pytest.raises(UserError, match="--replace"):
        session.run("import_trajectory", **flags)
    session.run("import_trajectory", **flags, replace=True, orientation_sigma_deg=3.0)
    assert len(session.vi_map.transformation_edges) == VERTICES - 1


def test_a_mission_of_its_own(tmp_path: Path) -> None:
    path, poses = tmp_path / "walk.txt", truth(flat_map())
    write_tum(poses, path)
    with Session() as session:
        report: Any = session.run("import_trajectory", trajectory_file=path, **{"as": "mission"})
        assert (report.kind, report.added) == ("mission", len(poses))
        assert session.maps.selected_key == "walk"
        assert check_consistency(session.vi_map).errors == ()
        np.testing.assert_allclose(session.vi_map.T_G_I, poses.T_R_B, atol=1e-9)
        first = session.vi_map
        session.run("save", map_folder=tmp_path / "map")
        session.run("load", map_folder=tmp_path / "map", map_key="again")
        np.testing.assert_array_equal(session.vi_map.vertices.id, first.vertices.id)
        with pytest.raises(MapError, match="both maps"):
            session.run("import_trajectory", trajectory_file=path, **{"as": "mission"})
        session.run(
            "import_trajectory", trajectory_file=path, time_offset_s=100.0, **{"as": "mission"}
        )
        assert len(session.vi_map.missions) == 2
        before = session.vi_map.T_G_I
        session.run("optvi", ba_include_6dof_odometry=True, ba_include_visual=False)
        np.testing.assert_allclose(session.vi_map.T_G_I, before, atol=1e-6)


def test_kitti(tmp_path: Path) -> None:
    poses, path, times = truth(flat_map()), tmp_path / "00.txt", tmp_path / "times.txt"
    np.savetxt(path, se3.to_matrix(poses.T_R_B)[:, :3].reshape(-1, 12))
    np.savetxt(times, (poses.times_ns - poses.times_ns[0]) * 1e-9)
    result = read_kitti(path, times)
    np.testing.assert_allclose(se3.local(result.T_R_B, poses.T_R_B), 0.0, atol=1e-9)
    assert np.abs(np.diff(result.times_ns) - np.diff(poses.times_ns)).max() <= 1
    times.write_text("\n".join(map(str, (poses.times_ns + 1_403_715_273_262_142_976).tolist())))
    stamped = read_kitti(path, times)
    assert stamped.times_ns.tolist() == (poses.times_ns + 1_403_715_273_262_142_976).tolist()
    assert stamped.note == f"{times}: time stamps are read as ns"
    times.write_text("0.0\n0.1\n")
    with pytest.raises(MapError, match="2 time stamps"):
        read_kitti(path, times)
    path.write_text("1 0 0 0 1 0 0 0 1 0 0 0\n")
    times.write_text("0.0\n")
    with pytest.raises(MapError, match=r"00\.txt: pose 1"):
        read_kitti(path, times)
    path.write_text("1 2 3\n")
    with pytest.raises(MapError, match=r"00\.txt:1"):
        read_kitti(path, times)


@pytest.mark.parametrize(
    ("text", "flags", "message"),
    [
        ("", {}, "no rows"),
        ("1.0 2 3\n", {}, "no trajectory"),
        ("2.0 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n", {}, "before that of the row above"),
        (
            "1.0 0 0 0 0 0 0 1\n1.0 1 0 0 0 0 0 1\n",
            {},
            ":2: has the time stamp of line 1, but another",
        ),
        ("1.0 0 0 0 0 0 0 2\n", {}, "unit length"),
        ("1.0 0 0 0 0 0 0 1\n", {"position_sigma_m": 0.0}, "position_sigma_m"),
        ("1.0 0 0 0 0 0 0 1\n", {"sensor_id": "f" * 32}, "poses from"),
        ("1.0 0 0 0 0 0 0 1\n", {"as": "mission"}, "needs two poses"),
    ],
)
def test_wrong_files(
    text: str, flags: dict[str, Any], message: str, session: Session, tmp_path: Path
) -> None:
    path, before = tmp_path / "poses.txt", session.vi_map
    path.write_text(text)
    mission = before.mission(0).id[:8]
    with pytest.raises(MaplabError, match=message) as error:
        session.run("import_trajectory", trajectory_file=path, map_mission=mission, **flags)
    assert "\n" not in str(error.value)
    assert session.vi_map is before


@pytest.mark.parametrize("kind", ["absolute", "odometry"])
def test_another_order_of_quaternions_is_refused(
    kind: str, session: Session, tmp_path: Path
) -> None:
    poses, path = truth(session.vi_map), tmp_path / "poses.txt"
    wrong = se3.make(np.roll(poses.T_R_B[:, :4], 1, axis=1), poses.T_R_B[:, 4:])
    write_tum(Trajectory(poses.times_ns, wrong), path)
    flags = {"map_mission": session.vi_map.mission(0).id[:8], "as": kind}
    with pytest.raises(EstimationError, match=r"deg, qw first would give [\d.e-]+ deg"):
        session.run("import_trajectory", trajectory_file=path, **flags)
    text = "# timestamp tx ty tz qw qx qy qz\n# a further comment\n" + path.read_text()
    path.write_text(text)
    report: Any = session.run("import_trajectory", trajectory_file=path, **flags)
    assert report.added > 1
    assert report.notes == ()


def test_positions_become_absolute_positions(session: Session, tmp_path: Path) -> None:
    poses, path = truth(session.vi_map), tmp_path / "positions.txt"
    rows = zip(poses.times_ns.tolist(), poses.T_R_B[:, 4:].tolist(), strict=True)
    path.write_text("".join(f"{t} {p[0]:.17g} {p[1]:.17g} {p[2]:.17g}\n" for t, p in rows))
    flags = {"trajectory_file": path, "map_mission": session.vi_map.mission(0).id[:8]}
    with pytest.raises(UserError, match="positions only"):
        session.run("import_trajectory", **flags, **{"as": "odometry"})
    report: Any = session.run("import_trajectory", **flags)
    assert report.added == VERTICES
    measured = session.vi_map.absolute_poses
    np.testing.assert_allclose(measured.T_G_S, session.vi_map.T_G_I[measured.vertex], atol=1e-6)
    assert np.sqrt(measured.covariance[0, 5, 5]) == pytest.approx(1e3)


def test_a_trajectory_that_lies_on_its_side_is_refused(session: Session, tmp_path: Path) -> None:
    poses, path = truth(session.vi_map), tmp_path / "poses.txt"
    aside = se3.make(so3.exp([1.5, 0.0, 0.0]), np.zeros(3))
    write_tum(Trajectory(poses.times_ns, se3.compose(aside, poses.T_R_B)), path)
    with pytest.raises(EstimationError, match="vertical"):
        session.run(
            "import_trajectory", trajectory_file=path, map_mission=session.vi_map.mission(0).id[:8]
        )


def test_a_third_of_wrong_positions_does_not_turn_the_alignment() -> None:
    rng = np.random.default_rng(5)
    p_M = np.cumsum(rng.normal(size=(300, 3)), axis=0)
    p_G = se3.transform(TURN, p_M)
    p_G[::3] += rng.normal(size=(100, 3)) * 20.0
    np.testing.assert_allclose(robust_yaw_position(p_G, p_M), TURN, atol=1e-3)
