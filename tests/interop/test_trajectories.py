"""Trajectory files: every format, exact times, clear refusals; maplab's two exports."""

from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.imu_csv import ImuRecording, read_imu_csv, write_imu_csv
from maplab_py.interop.trajectories import Trajectory, read_trajectory, write_euroc, write_tum
from maplab_py.interop.vertex_states import vertex_states, write_asl
from maplab_py.vimap import ids
from tests.interop.small_map import CAMERA_ID, IMU_ID, RIG_ID, VERTICES, make_map, position
from tests.support.data import shared_data


def make_trajectory(count: int = 50, *, with_state: bool = True) -> Trajectory:
    rng = np.random.default_rng(5)
    times = 1403715529112143517 + np.cumsum(rng.integers(1, 10**9, count))
    T = np.concatenate([so3.exp(rng.normal(size=(count, 3))), rng.normal(size=(count, 3))], axis=1)
    state = rng.normal(size=(3, count, 3)) if with_state else (None, None, None)
    return Trajectory(times, T, *state)


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "trajectory.txt"
    path.write_text(text)
    return path


@pytest.mark.parametrize("with_state", [True, False])
def test_euroc_round_trip(tmp_path: Path, with_state: bool) -> None:
    trajectory = make_trajectory(with_state=with_state)
    write_euroc(trajectory, tmp_path / "a.csv")
    read = read_trajectory(tmp_path / "a.csv")
    assert np.array_equal(read.times_ns, trajectory.times_ns)
    assert np.max(np.abs(read.T_R_B - trajectory.T_R_B)) < 1e-15
    for name in ("v_R", "gyro_bias", "accel_bias"):
        given, found = getattr(trajectory, name), getattr(read, name)
        assert (found is None) if given is None else np.array_equal(given, found)


@pytest.mark.parametrize(
    ("text", "pose"),
    [
        ("0.5 1 2 3 0.6 0 0 0.8\n", [0.6, 0, 0, 0.8, 1, 2, 3]),
        ("1400000000000000000,1,2,3,0.8,0.6,0,0\n", [0.6, 0, 0, 0.8, 1, 2, 3]),
        ("#t,x,y,z,qw,qx,qy,qz\n0.5,1,2,3,0.8,0.6,0,0\n", [0.6, 0, 0, 0.8, 1, 2, 3]),
        ("time,qx,qy,qz,qw,tx,ty,tz\n0.5,0.6,0,0,0.8,1,2,3\n", [0.6, 0, 0, 0.8, 1, 2, 3]),
        ("timestamp;\n0.5\t1 2  3 0.6 0 0 0.8", [0.6, 0, 0, 0.8, 1, 2, 3]),
        (
            "timestamp [ns], position x [m], position y [m], position z [m], quaternion x, "
            "quaternion y, quaternion z, quaternion w\n5,1,2,3,0.6,0,0,0.8\n",
            [0.6, 0, 0, 0.8, 1, 2, 3],
        ),
    ],
)
def test_formats_are_told_from_content(tmp_path: Path, text: str, pose: list[float]) -> None:
    read = read_trajectory(written(tmp_path, text))
    assert len(read) == 1
    assert read.T_R_B[0] == pytest.approx(pose, abs=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "there are no rows"),
        ("# only a comment\n", "there are no rows"),
        ("1 2 3 4 0 0 0 1\n2 3 4\n", r":2: 3 columns, the first row has 8"),
        ("1 2 3 4 0 0 0 1\n\n2 3 x 4 0 0 0 1\n", r":3: 'x' is not a finite number"),
        ("1 2 3 nan 0 0 0 1\n", r":1: 'nan' is not a finite number"),
        ("1 2 3 4 0 0 0 1\nlater 2 3 4 0 0 0 1\n", r":2: 'later' is not a time stamp"),
        ("1 2 3 4 0 0 0 2\n", r":1: the quaternion is not of unit length"),
        ("2 2 3 4 0 0 0 1\n1 2 3 4 0 0 0 1\n", r":2: the time stamp lies before"),
        ("1 2 3\n", "there is no column for px, py, pz;"),
        (
            "# t x y z qx qy qz qw\n1 2 3 4 0 0 0 1\n# t x y z qw qx qy qz\n",
            "two lines name the columns",
        ),
        ("t,x,y,z,q0,q1,q2,q3\n1,0,0,0,1,0,0,0\n", "no column for qx"),
        ("vertex index,px,py,pz,qw,qx,qy,qz\n1,2,3,4,1,0,0,0\n", "must be the time stamp"),
        ("5\n", "a time stamp and values are expected"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(MapError, match=message) as caught:
        read_trajectory(written(tmp_path, text))
    assert "trajectory.txt" in str(caught.value)
    assert "\n" not in str(caught.value)


ROW = "0.5 1 2 3 0.8 0.6 0 0\n"


@pytest.mark.parametrize(
    "text",
    [
        "# timestamp tx ty tz qw qx qy qz\n# another comment line\n" + ROW,
        "# made by a program\n# timestamp tx ty tz qw qx qy qz\n# and eight more words of a comment\n"
        + ROW,
        "# timestamp tx ty tz qw qx qy qz\n# stamps are made in seconds by this clock\n" + ROW,
        "# a comment\ntimestamp tx ty tz qw qx qy qz\n" + ROW,
        ROW + "# timestamp tx ty tz qw qx qy qz\n",
        "# timestamp [s] tx [m] ty [m] tz [m] qw qx qy qz\n" + ROW,
        '"time","x","y","z","q_w","q_x","q_y","q_z"\n0.5,1,2,3,0.8,0.6,0,0\n',
        "%time,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
        "field.pose.orientation.w,field.pose.orientation.x,field.pose.orientation.y,"
        "field.pose.orientation.z\n0.5,1,2,3,0.8,0.6,0,0\n",
        "sec,nanosec,x,y,z,qw,qx,qy,qz\n0,500000000,1,2,3,0.8,0.6,0,0\n",
        "header.stamp.secs,header.stamp.nsecs,x,y,z,qw,qx,qy,qz\n0,500000000,1,2,3,0.8,0.6,0,0\n",
        "timestamp;tx;ty;tz;qw;qx;qy;qz\n0.5;1;2;3;0.8;0.6;0;0\n",
        "x,y,z,qw,qx,qy,qz,timestamp [s]\n1,2,3,0.8,0.6,0,0,0.5\n",
        "time,frame_id,x,y,z,qw,qx,qy,qz\n0.5,odom,1,2,3,0.8,0.6,0,0\n",
        "time,frame_id,x,y,z,qw,qx,qy,qz,note\n0.5,,1,2,3,0.8,0.6,0,0,fast turn\n",
        "time,mission-id,x,y,z,qw,qx,qy,qz\n0.5,12345678,1,2,3,0.8,0.6,0,0\n",
    ],
)
def test_names_hold_wherever_they_stand(tmp_path: Path, text: str) -> None:
    read = read_trajectory(written(tmp_path, text))
    assert read.times_ns.tolist() == [500_000_000]
    assert read.T_R_B[0] == pytest.approx([0.6, 0, 0, 0.8, 1, 2, 3], abs=1e-15)


@pytest.mark.parametrize(
    "text",
    [
        "0 1 2 3\n1 2 3 4\n",
        "# t x y z\n0 1 2 3\n1 2 3 4\n",
        "time,x,y,z,speed\n0,1,2,3,9\n1,2,3,4,9\n",
    ],
)
def test_positions_are_read_where_they_suffice(tmp_path: Path, text: str) -> None:
    path = written(tmp_path, text)
    read = read_trajectory(path, needs_orientation=False)
    assert not read.has_orientation
    assert read.T_R_B[1].tolist() == [0, 0, 0, 1, 2, 3, 4]
    with pytest.raises(MapError, match="positions without orientations"):
        read_trajectory(path)


def test_rows_of_one_stamp_agree_or_are_both_named(tmp_path: Path) -> None:
    rows = "".join(f"{t} {0.1 * t} 0 0 0 0 0 1\n" for t in range(5))
    same = written(tmp_path, rows + "4 0.40004 0 0 0 0 0 1\n5 0.5 0 0 0 0 0 1\n")
    assert len(read_trajectory(same)) == 6
    assert len(read_trajectory(same, keep_repeated=True)) == 7
    for other in ("4 2.4 0 0 0 0 0 1\n", "4 0.4 0 0 0 0 1 0\n"):
        with pytest.raises(MapError, match=r":6: has the time stamp of line 5, but another pose"):
            read_trajectory(written(tmp_path, rows + other))


def test_missing_and_binary_files(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"cannot read .*absent"):
        read_trajectory(tmp_path / "absent.txt")
    (tmp_path / "binary").write_bytes(b"\xff\x00\xfe")
    with pytest.raises(MapError, match="it is not text"):
        read_trajectory(tmp_path / "binary")


def test_files_are_not_overwritten_unasked(tmp_path: Path) -> None:
    trajectory, path = make_trajectory(3), tmp_path / "folder" / "a.txt"
    write_tum(trajectory, path)
    before = path.read_bytes()
    with pytest.raises(UserError, match=r"a\.txt exists already: give --overwrite"):
        write_tum(make_trajectory(5), path)
    assert path.read_bytes() == before
    write_tum(make_trajectory(5), path, overwrite=True)
    assert len(read_trajectory(path)) == 5
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]
    with pytest.raises(UserError, match="is a folder"):
        write_tum(trajectory, path.parent)


def test_imu_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    recording = ImuRecording(
        np.arange(5) * 5_000_000 + 1403715273262142976, rng.normal(size=(5, 6))
    )
    write_imu_csv(recording, tmp_path / "imu.csv")
    read = read_imu_csv(tmp_path / "imu.csv")
    assert np.array_equal(read.times_ns, recording.times_ns)
    assert np.array_equal(read.accel_gyro, recording.accel_gyro)


def test_imu_bad_files(tmp_path: Path) -> None:
    path = tmp_path / "imu.csv"
    path.write_text("1,2,3,4\n")
    with pytest.raises(MapError, match="7 columns are expected"):
        read_imu_csv(path)
    path.write_text("2,1,1,1,1,1,1\n2,1,1,1,1,1,1\n")
    with pytest.raises(MapError, match=r":2: the time stamp does not come after"):
        read_imu_csv(path)


@pytest.mark.parametrize(
    ("relative", "count", "has_state"),
    [
        ("ground_truth/V1_01_easy.csv", 28712, True),
        ("euroc_imu/V101.gt.csv", 2895, True),
        ("tumvi_imu/room1.gt.csv", 16541, False),
        ("trajectories/V102.txt", 807, False),
        ("trajectories/freiburg1_xyz-groundtruth.txt", 3000, False),
    ],
)
def test_real_trajectories(relative: str, count: int, has_state: bool) -> None:
    trajectory = read_trajectory(shared_data(relative), keep_repeated=True)
    assert len(trajectory) == count
    assert np.all(np.diff(trajectory.times_ns) >= 0)
    assert (trajectory.accel_bias is not None) == has_state


def test_states_of_all_vertices() -> None:
    vi_map = make_map()
    states = vertex_states(vi_map)
    assert np.array_equal(states.time_ns, vi_map.vertices.timestamp_ns)
    assert np.array_equal(states.T_G_S, vi_map.T_G_I)
    one = vertex_states(vi_map, missions=np.array([1]))
    assert one.vertex.tolist() == list(range(VERTICES, 2 * VERTICES))
    assert len(vertex_states(vi_map, missions=np.zeros(0, dtype=int))) == 0


def test_asl_columns(tmp_path: Path) -> None:
    vi_map = make_map()
    write_asl(vi_map, vertex_states(vi_map), tmp_path / "a.csv")
    header, *rows = (tmp_path / "a.csv").read_text().splitlines()
    assert header.split(", ")[:4] == ["# timestamp [ns]", "vertex-id", "mission-id", "p_G_Ix [m]"]
    assert len(header.split(", ")) == 26
    assert len(rows) == 2 * VERTICES
    fields = rows[7].split(", ")
    assert int(fields[0]) == vi_map.vertices.timestamp_ns[7]
    assert fields[1] == ids.to_hex(vi_map.vertices.id[7])
    assert fields[2] == ids.to_hex(vi_map.missions.id[1])
    numbers = np.array([float(text) for text in fields[3:]])
    T_G, T_M = vi_map.T_G_I[7], vi_map.vertices.T_M_I[7]
    assert np.array_equal(numbers[:7], [*T_G[4:], T_G[3], *T_G[:3]])
    assert np.array_equal(numbers[7:14], [*T_M[4:], T_M[3], *T_M[:3]])
    assert np.array_equal(numbers[14:17], vi_map.vertices.v_M[7])
    assert np.array_equal(numbers[17:20], vi_map.vertices.gyro_bias[7])
    assert np.array_equal(numbers[20:23], vi_map.vertices.accel_bias[7])


@pytest.mark.parametrize("sensor_id", [IMU_ID, RIG_ID, CAMERA_ID])
def test_poses_of_another_sensor(sensor_id: str) -> None:
    vi_map = make_map()
    states = vertex_states(vi_map, reference_sensor_id=sensor_id)
    T_I_S = vi_map.sensors.T_I_S(IMU_ID, sensor_id)
    assert np.allclose(states.T_G_S, se3.compose(vi_map.T_G_I, T_I_S), atol=1e-14)
    expected = {IMU_ID: se3.identity(), RIG_ID: vi_map.sensors.T_B_S(RIG_ID)}
    rig = vi_map.sensors.camera_rig(RIG_ID)
    expected[CAMERA_ID] = se3.compose(vi_map.sensors.T_B_S(RIG_ID), rig.T_B_C[0])
    assert np.allclose(T_I_S, expected[sensor_id])


def test_unknown_sensor() -> None:
    with pytest.raises(UserError, match=r"pose_export_reference_sensor_id: .*no sensor with id"):
        vertex_states(make_map(), reference_sensor_id="f" * 32)


def test_states_at_imu_times_follow_the_motion() -> None:
    vi_map = make_map()
    states = vertex_states(vi_map, at_imu_times=True)
    assert len(states) == 2 * ((VERTICES - 1) * 50 + 1)
    at_vertex = np.isin(states.time_ns, vi_map.vertices.timestamp_ns)
    assert np.max(np.abs(se3.local(states.T_G_S[at_vertex], vi_map.T_G_I))) < 1e-12
    half = len(states) // 2
    t = (states.time_ns[:half] - states.time_ns[0]) * 1e-9
    assert np.max(np.abs(states.T_M_S[:half, 4:] - position(t))) < 2e-4
    q = so3.exp(np.stack([0 * t, 0.3 * t, 0 * t], axis=1))
    error = so3.log(so3.multiply(so3.inverse(q), states.T_M_S[:half, :4]))
    assert np.max(np.abs(error)) < 1e-12
