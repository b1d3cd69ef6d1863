"""Tables of other programs: names and units of columns, dates, quotes, decimal commas, encodings."""

from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.interop import gps, wheel_odometry
from maplab_py.interop.imu_csv import read_imu_csv
from maplab_py.interop.trajectories import read_trajectory

NOW, STEP = 1403715273262142976, 50_000_000
TURN = [0.1, 0.2, 0.3, 0.9273618495495703]  # x y z w
POSE = "{row},0,0,0.1,0.2,0.3,0.9273618495495703"
GYRO, ACCEL = [0.1, 0.2, 0.3], [1.0, 2.0, 9.8]
DEG = np.pi / 180.0


def written(tmp_path: Path, header: str, row: str, *, encoding: str = "utf-8") -> Path:
    """Write a table of five rows, whose form may name row, t, s and ns."""
    stamps = [NOW + STEP * row for row in range(5)]
    rows = [
        row.format(row=k, t=t, s=t // 10**9, ns=t % 10**9, index=k + 7, z=9 * k)
        for k, t in enumerate(stamps)
    ]
    path = tmp_path / "table.csv"
    path.write_bytes("\n".join([header, *rows, ""]).encode(encoding))
    return path


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("timestamp [ns],x [mm],y [mm],z [mm],qx,qy,qz,qw", "{t},{row}000" + POSE[5:]),
        ("timestamp [ns],x [cm],y [cm],z [cm],qx,qy,qz,qw", "{t},{row}00" + POSE[5:]),
        ("time,pos.x,pos.y,pos.z,quat.w,quat.x,quat.y,quat.z", "{t},{row},0,0," + f"{TURN[3]},.1,.2,.3"),
        ("t,position.x,position.y,position.z,orientation.x,orientation.y,orientation.z,orientation.w",
         "{t}," + POSE),
        ('"timestamp","x","y","z","qx","qy","qz","qw"',
         '"{t}","{row}","0","0","0.1","0.2","0.3","' + f'{TURN[3]}"'),
        ("timestamp;x;y;z;qx;qy;qz;qw", "{t};{row},0;0,0;0;0,1;0,2;0,3;" + f"{TURN[3]}".replace(".", ",")),
        ("# frame timestamp tx ty tz qx qy qz qw", "{index} {s}.{ns:09d} " + POSE.replace(",", " ")),
        ("sec,nanosec,x [mm],y,z,qx,qy,qz,qw", "{s},{ns},{row}000" + POSE[5:]),
        ("# frame_id (timestamp ns), translation_x, translation_y, translation_z, quaternion_x, "
         "quaternion_y, quaternion_z, quaternion_w, scale", "{t}, " + POSE + ",1"),
        ("t [ns],x_mm,y_mm,z_mm,ox,oy,oz,ow", "{t},{row}000" + POSE[5:]),
        ("t;posX;posY;posZ;rotX;rotY;rotZ;rotW", "{t};" + POSE.replace(",", ";")),
        ("/time,/odom/pose/orientation/w,/odom/pose/orientation/x,/odom/pose/orientation/y,"
         "/odom/pose/orientation/z,/odom/pose/position/x,/odom/pose/position/y,/odom/pose/position/z,"
         "/odom/twist/linear/x", "{t}," + f"{TURN[3]},.1,.2,.3," + "{row},0,0,7"),
        ("Zeit (°)\ttime\tx\ty\tz\tqx\tqy\tqz\tqw",
         "{z}\t{s},{ns:09d}\t" + POSE.replace(",", "\t").replace(".", ",")),
        ("t,x,y,z,qx,qy,qz,qw", "{t},{row},\u22120,0,0.1,0.2,0.3,0.9273618495495703"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_trajectories(tmp_path: Path, header: str, row: str, encoding: str) -> None:
    if encoding == "latin-1" and not row.isascii():
        row = row.replace("\u2212", "-")
    trajectory = read_trajectory(written(tmp_path, header, row, encoding=encoding))
    assert trajectory.times_ns.tolist() == [NOW + STEP * k for k in range(5)]
    np.testing.assert_allclose(trajectory.T_R_B[:, :4], [TURN] * 5, atol=1e-12)
    np.testing.assert_allclose(trajectory.T_R_B[:, 4:], [[k, 0, 0] for k in range(5)], atol=1e-12)


@pytest.mark.parametrize(
    ("stamp", "first_ns"),
    [
        ("2023-11-14T22:13:2{row}.250Z", 1700000000_250_000_000),
        ("2023-11-14 22:13:2{row}.250000001", 1700000000_250_000_001),
        ("2023/11/14 22:13:2{row}", 1700000000_000_000_000),
        ('"2023-11-14T22:13:2{row}+00:00"', 1700000000_000_000_000),
    ],
)
def test_dates_are_exact(tmp_path: Path, stamp: str, first_ns: int) -> None:
    path = written(tmp_path, "timestamp,x,y,z,qx,qy,qz,qw", stamp + "," + POSE)
    assert read_trajectory(path).times_ns.tolist() == [first_ns + k * 10**9 for k in range(5)]


@pytest.mark.parametrize(
    ("header", "row", "message"),
    [
        ("time,x,y,z,qx,qy,qz,qw", "2023-11-14T22:13:2{row}+02:00," + POSE, "no rows that begin with a time"),
        ("time,x,y,z,qx,qy,qz,qw", "2023-02-30T22:13:2{row}," + POSE, "no rows that begin with a time"),
        ("GPST,x,y,z,qx,qy,qz,qw", "2023/11/14 22:13:2{row}," + POSE, "leap seconds .*: write UTC"),
        ("t [ns],x [yd],y [yd],z [yd],qx,qy,qz,qw", "{t}," + POSE, r"'x' is in \[yd\].* unit of length"),
        ("t [ns],x,y,z,qx,qy,qz,qw", "{z}0000000," + POSE + "\n5,0,0,0,0,0,0,1", "sort the rows by time"),
        ("Frame,Time [ns],X,Y,Z,W,X,Y,Z", "{row},{t},.1,.2,.3,.9,{row},0,0", "'x' and 'x' mean the same"),
        ("t,lat,lon,alt", "{t},47,8,400", "there is no column for px"),
        ("t,device,x,y,z,qx,qy,qz,qw,*more", "{t},ios," + POSE, "'ios' is no number: .* names each of the 9"),
        ("", "1 0 0 {row} 0 1 0 0 0 0 1 0", "KITTI's matrices with --times_file"),
    ],
)  # fmt: skip
def test_trajectories_that_are_refused(tmp_path: Path, header: str, row: str, message: str) -> None:
    with pytest.raises(MapError, match=message):
        read_trajectory(written(tmp_path, header, row))


def test_columns_without_names_are_noted_where_programs_differ(tmp_path: Path) -> None:
    note = "columns without names are read as t, x, y, z, qx, qy, qz, qw"
    assert note in read_trajectory(written(tmp_path, "", "{s}.{ns:09d}," + POSE)).note
    blanks = POSE.replace(",", " ")
    assert not read_trajectory(written(tmp_path, "", "{s}.{ns:09d} " + blanks)).note


G, A, W = "0.1,0.2,0.3", "1,2,9.8", "{t},"


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("t,angular_velocity.x,angular_velocity.y,angular_velocity.z,linear_acceleration.x,"
         "linear_acceleration.y,linear_acceleration.z", W + f"{G},{A}"),
        ("t,linear_acceleration_x,linear_acceleration_y,linear_acceleration_z,angular_velocity_x,"
         "angular_velocity_y,angular_velocity_z", W + f"{A},{G}"),
        ("t,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z", W + f"{G},{A}"),
        ("t,acc_x,acc_y,acc_z,gyro_x,gyro_y,gyro_z", W + f"{A},{G}"),
        ("t,ax,gx,ay,gy,az,gz", W + "1,0.1,2,0.2,9.8,0.3"),
        ("t,gz,gy,gx,az,ay,ax", W + "0.3,0.2,0.1,9.8,2,1"),
        ("t,gx,gy,gz,ax,ay,az,temperature", W + f"{G},{A},25"),
        ("t,c1,c2,c3,c4,c5,c6", W + f"{G},{A}"),
        ("%time,field.header.seq,field.header.stamp,field.header.frame_id,field.orientation.x,"
         "field.orientation.y,field.orientation.z,field.orientation.w,field.angular_velocity.x,"
         "field.angular_velocity.y,field.angular_velocity.z,field.linear_acceleration.x,"
         "field.linear_acceleration.y,field.linear_acceleration.z",
         "{t},{row},{t},imu,0,0,0,1," + f"{G},{A}"),
        ("t [ns],w_x [deg/s],w_y [deg/s],w_z [deg/s],a_x [m/s^2],a_y [m/s^2],a_z [m/s^2]",
         W + ",".join(f"{v / DEG:.17g}" for v in GYRO) + f",{A}"),
        ("t,gyro_x_deg_s,gyro_y_deg_s,gyro_z_deg_s,acc_x_m_s2,acc_y_m_s2,acc_z_m_s2",
         W + ",".join(f"{v / DEG:.17g}" for v in GYRO) + f",{A}"),
        ("/t,/imu/linear_acceleration/x,/imu/linear_acceleration/y,/imu/linear_acceleration/z,"
         "/imu/angular_velocity/x,/imu/angular_velocity/y,/imu/angular_velocity/z", W + f"{A},{G}"),
        ("# id timestamp ang_vel_x ang_vel_y ang_vel_z lin_acc_x lin_acc_y lin_acc_z",
         "{row} {t} " + f"{G},{A}".replace(",", " ")),
        ("", W + f"{G},{A}"),
        ("t [ns],w_x [rad s^-1],w_y [rad s^-1],w_z [rad s^-1],a_x [g],a_y [g],a_z [g]",
         W + f"{G}," + ",".join(f"{v / 9.80665:.17g}" for v in ACCEL)),
    ],
)  # fmt: skip
def test_imu_samples_are_those_that_columns_name(tmp_path: Path, header: str, row: str) -> None:
    samples = read_imu_csv(written(tmp_path, header, row))
    np.testing.assert_allclose(samples.accel_gyro, [ACCEL + GYRO] * 5, rtol=1e-15)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (
            "t,w_x,w_y,w_z,linear_acceleration_x,a_y,a_z,a_x",
            "_x' and 'a_x' mean the same",
        ),
        ("t,mag_x,mag_y,mag_z,acc_x,acc_y,acc_z", "names as w_x.*: it has mag_x"),
        ("t,w_x [rpm],w_y,w_z,a_x,a_y,a_z", r"\[rpm\], which is not known as a unit of rate"),
    ],
)
def test_imu_columns_that_are_refused(tmp_path: Path, header: str, message: str) -> None:
    with pytest.raises(MapError, match=message.replace(": it", ".*it")):
        read_imu_csv(written(tmp_path, header, W + f"{G},{A}" + ",0" * (header.count(",") - 6)))


def test_gravity_tells_which_columns_without_names_are_accelerations(tmp_path: Path) -> None:
    samples = read_imu_csv(written(tmp_path, "", W + f"{A},{G}"))
    np.testing.assert_array_equal(samples.accel_gyro, [ACCEL + GYRO] * 5)
    assert "accelerations come first, as gravity shows" in samples.note


@pytest.mark.parametrize(
    ("header", "row", "x_m", "yaw_rad"),
    [
        ("t [ns],x [m],y [m],yaw [deg]", "{t},0.{row},0,{row}", 0.4, 4 * DEG),
        ("t [ns],x [mm],y [mm],yaw [rad]", "{t},{row}00,0,0.{row}", 0.4, 0.4),
        ("t [ns],vx [km/h],wz [deg/s]", "{t},7.2,0", 0.4, 0.0),
        ("t,linear.x,linear.y,linear.z,angular.x,angular.y,angular.z", "{t},2,0,0,0,0,0", 0.4, 0.0),
        ("t,field.pose.pose.position.x,field.pose.pose.position.y,field.pose.pose.position.z,"
         "field.pose.pose.orientation.x,field.pose.pose.orientation.y,field.pose.pose.orientation.z,"
         "field.pose.pose.orientation.w", "{t},0.{row},0,0,0,0,0,1", 0.4, 0.0),
    ],
)  # fmt: skip
def test_wheels(tmp_path: Path, header: str, row: str, x_m: float, yaw_rad: float) -> None:
    track = wheel_odometry.read_wheel_odometry(written(tmp_path, header, row))
    np.testing.assert_allclose(track.T_O_S[-1, 4:], [x_m, 0.0, 0.0], atol=1e-12)
    assert 2.0 * np.arctan2(*track.T_O_S[-1, 2:4]) == pytest.approx(yaw_rad, abs=1e-12)


@pytest.mark.parametrize(
    ("header", "row", "altitude_m"),
    [
        ("time,lat,lon,alt", "2023-11-14T22:13:2{row}Z,47.1,8.5,400", 400.0),
        ("Time (s),Latitude (deg),Longitude (deg),Altitude (ft)", "170000000{row},47.1,8.5,1000", 304.8),
        ("%  UTC    latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)",
         "2023/11/14 22:13:2{row}.000   47.100   8.500   400.0   1   9   0.01", 400.0),
        ("time,lat,N/S,lon,E/W,alt_ft", "170000000{row},47.1,N,8.5,E,1000", 304.8),
        ("time,lat,lon,alt", "170000000{row},47.1N,8.5E,400", 400.0),
    ],
)  # fmt: skip
def test_fixes(tmp_path: Path, header: str, row: str, altitude_m: float) -> None:
    track = gps.read_gps(written(tmp_path, header, row))
    assert track.times_ns.tolist() == [(1_700_000_000 + k) * 10**9 for k in range(5)]
    assert (track.latitude_deg[0], track.longitude_deg[0]) == (47.1, 8.5)
    np.testing.assert_allclose(track.altitude_m, altitude_m, rtol=1e-15)


@pytest.mark.parametrize("row", ["17{row},47.1,S,8.5,W,400", "17{row},47.1 S,,8.5W,,400"])
def test_hemispheres(tmp_path: Path, row: str) -> None:
    track = gps.read_gps(written(tmp_path, "t [s],lat,ns,lon,ew,alt", row))
    assert (track.latitude_deg[0], track.longitude_deg[0]) == (-47.1, -8.5)


def test_gpx_is_named(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="is XML, as GPX or KML: convert it to CSV"):
        gps.read_gps(written(tmp_path, "<?xml version='1.0'?><gpx>", "<trkpt lat='47' lon='8'/>"))
