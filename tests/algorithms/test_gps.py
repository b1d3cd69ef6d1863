"""Satellite positions: files, the frame that G becomes, and a drifting loop with outliers."""

import dataclasses
import datetime as dt
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest

from maplab_py.algorithms.external_poses import gps, trajectories
from maplab_py.algorithms.external_poses.options import TrajectoryOptions
from maplab_py.algorithms.vi_optimization.factor_terms import absolute_outliers
from maplab_py.algorithms.vi_optimization.map_problem import build
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.console.session.session import Session
from maplab_py.errors import MaplabError, UserError
from maplab_py.geometry import alignment, se3, so3
from maplab_py.interop.gps import read_gps
from maplab_py.interop.trajectories import Trajectory
from maplab_py.vimap import AbsolutePoses, VIMap, merge

ORIGIN = (47.3769, 8.5417, 450.0)
START_NS = 1_700_000_000_000_000_000
ARM_I = np.array([0.2, -0.1, 0.5])


def loop(seconds: int = 600, rate: int = 2, radius_m: float = 60.0) -> Trajectory:
    """Two rounds of a figure of eight with hills, level except for some roll and pitch."""
    t = np.arange(seconds * rate + 1) / rate
    angle = 4.0 * np.pi * t / seconds
    p = np.stack(
        [radius_m * np.sin(angle), radius_m * np.sin(2.0 * angle) / 2.0, 4.0 * np.sin(3.0 * angle)],
        1,
    )
    heading = np.unwrap(np.arctan2(*np.gradient(p[:, :2], axis=0).T[::-1]))
    tilt = np.stack([0.1 * np.sin(t), 0.1 * np.cos(0.7 * t), 0 * t], axis=1)
    turn = np.stack([0 * t, 0 * t, heading], axis=1)
    q = so3.multiply(so3.exp(turn), so3.exp(tilt))
    return Trajectory(START_NS + (t * 1e9).astype(np.int64), se3.make(q, p))


def drifting(truth: Trajectory, seed: int, scale: float = 1.02) -> Trajectory:
    """Return what an odometry with a wrong scale, noise and a turning heading makes of it."""
    rng = np.random.default_rng(seed)
    T_A_B = se3.relative(truth.T_R_B[:-1], truth.T_R_B[1:])
    T_A_B[:, 4:] *= scale
    sigma = np.array([0.02, 0.02, 0.02, 2e-4, 2e-4, 1.5e-3]) * np.sqrt(0.5)
    T_A_B = se3.retract(T_A_B, sigma * rng.standard_normal((len(T_A_B), 6)))
    T = [se3.make(so3.exp([0.0, 0.0, 2.0]), np.array([3.0, 4.0, 5.0]))]
    for step in T_A_B:
        T.append(se3.compose(T[-1], step))
    return dataclasses.replace(truth, T_R_B=np.stack(T))


def fixes(truth: Trajectory, every: int, seed: int, sigma_m: float = 0.5) -> tuple[Any, Any]:
    """Return east, north, up (N, 3) of the antenna and which of them (N,) are 20 m off."""
    rng = np.random.default_rng(seed)
    T = truth.T_R_B[::every]
    p = se3.transform(T, np.broadcast_to(ARM_I, (len(T), 3)))
    p = p + sigma_m * rng.standard_normal(p.shape)
    wrong = np.zeros(len(p), dtype=np.bool_)
    wrong[rng.choice(len(p), round(0.05 * len(p)), replace=False)] = True
    away = rng.standard_normal(p.shape)
    p[wrong] += 20.0 * (away / np.linalg.norm(away, axis=1)[:, None])[wrong]
    return p, wrong


def write_csv(path: Path, times_ns: Any, p: Any) -> Path:
    lat, lon, alt = pymap3d.enu2geodetic(*p.T, *ORIGIN)
    lines = [
        f"{t},{a:.10f},{o:.10f},{h:.4f}" for t, a, o, h in zip(times_ns, lat, lon, alt, strict=True)
    ]
    path.write_text(
        "timestamp [ns], latitude [deg], longitude [deg], altitude [m]\n" + "\n".join(lines)
    )
    return path


def sentence(body: str) -> str:
    check = 0
    for byte in body.encode():
        check ^= byte
    return f"${body}*{check:02X}"


def write_nmea(path: Path, times_ns: Any, p: Any, *, with_date: bool = True) -> Path:
    lat, lon, alt = pymap3d.enu2geodetic(*p.T, *ORIGIN)
    lines = []
    for t, a, o, h in zip(np.asarray(times_ns).tolist(), lat, lon, alt, strict=True):
        when = dt.datetime.fromtimestamp(t // 10**9, tz=dt.UTC)
        clock = f"{when:%H%M%S}.{t % 10**9 // 10**6:03d}"
        place = f"{int(a):02d}{(a % 1) * 60:011.8f},N,{int(o):03d}{(o % 1) * 60:011.8f},E"
        if with_date:
            lines.append(sentence(f"GNRMC,{clock},A,{place},0.0,0.0,{when:%d%m%y},,,A"))
        lines.append(sentence(f"GNGGA,{clock},{place},4,12,0.8,{h - 47.5:.4f},M,47.5,M,,"))
    path.write_text("\n".join(lines) + "\n")
    return path


def map_of(trajectory: Trajectory) -> VIMap:
    options = TrajectoryOptions(position_sigma_m=0.06, orientation_sigma_deg=0.1)
    return trajectories.as_mission(trajectory, options)


def errors_m(vi_map: VIMap, truth: Trajectory) -> tuple[float, float]:
    """Return the root mean square error in G without alignment, and the scale against the truth."""
    p = vi_map.T_G_I[:, 4:]
    error = np.linalg.norm(p - truth.T_R_B[:, 4:], axis=1)
    scale = alignment.umeyama(truth.T_R_B[:, 4:], p, with_scale=True)[1]
    return float(np.sqrt(np.mean(error**2))), scale


OPTVI = {
    "ba_include_visual": False,
    "ba_include_inertial": False,
    "ba_include_6dof_odometry": True,
    "ba_include_absolute_pose_constraints": True,
    "ba_num_iterations": 100,
}


@pytest.mark.parametrize("seed", [1, 2])
def test_a_drifting_loop_with_outliers(seed: int, tmp_path: Path) -> None:
    truth = loop()
    p, wrong = fixes(truth, 2, seed)
    path = write_csv(tmp_path / "track.csv", truth.times_ns[::2], p)
    with Session() as session:
        session.maps.add("loop", map_of(drifting(truth, seed)))
        flags = {"gps_sigma_m": 0.5, "gps_sigma_vertical_m": 0.5, "gps_lever_arm_m": "0.2,-0.1,0.5"}
        lat, lon, alt = ORIGIN
        report: Any = session.run(
            "import_gps", gps_file=path, gps_origin=f"{lat},{lon},{alt}", **flags
        )
        assert report.added == len(p)
        before, scale_before = errors_m(session.vi_map, truth)
        assert before > 1.0
        assert abs(scale_before - 1.0) > 0.01
        rows, T_I_S = np.arange(len(p)), se3.make(se3.identity()[:4], ARM_I)
        found = absolute_outliers(session.vi_map, rows, np.tile(T_I_S, (len(p), 1)), 5.0)
        assert np.all(found[wrong])
        assert np.count_nonzero(found[~wrong]) <= 2
        result: Any = session.run("optvi", **OPTVI)
        after, scale = errors_m(session.vi_map, truth)
        assert after <= 0.3
        assert abs(scale - 1.0) <= 0.002
        assert result.absolute_poses_rejected == np.count_nonzero(found)
        assert "nothing of 1 cluster" in result.gauge
        assert gps.origin_of(session.vi_map) == ORIGIN
        session.run("save", map_folder=tmp_path / "map")
        session.run("load", map_folder=tmp_path / "map", map_key="again")
        assert gps.origin_of(session.vi_map) == ORIGIN


def test_positions_say_nothing_of_orientation(tmp_path: Path) -> None:
    """Whitened, an error of one radian weighs as much as a thousandth of a deviation."""
    truth = loop(60, 2, 20.0)
    p = fixes(truth, 2, 1)[0]
    path = write_csv(tmp_path / "track.csv", truth.times_ns[::2], p)
    with Session() as session:
        session.maps.add("walk", map_of(truth))
        session.run("import_gps", gps_file=path, gps_sigma_m=0.5, gps_sigma_vertical_m=1.0)
        vi_map = session.vi_map
    options = VIOptimizationOptions(
        include_visual=False, include_inertial=False, include_absolute_pose_constraints=True
    )
    problem = build(vi_map, options)
    (term,) = problem.problem.factors
    _, jacobian = term.evaluate(problem.states)
    weight = np.linalg.norm(jacobian.reshape(len(jacobian), -1, 6), axis=1)  # of every direction
    np.testing.assert_allclose(weight[:, :3], np.tile([2.0, 2.0, 1.0], (len(weight), 1)), rtol=1e-9)
    assert weight[:, 3:].max() <= 1.5e-3
    assert problem.gauge.startswith("nothing of")


def test_g_becomes_east_north_up(tmp_path: Path) -> None:
    truth = loop(60, 2, 20.0)
    p = se3.transform(truth.T_R_B, np.broadcast_to(ARM_I, (len(truth), 3)))
    turned = se3.compose(
        se3.make(so3.exp([0.0, 0.0, -1.0]), np.array([7.0, 8.0, 9.0])), truth.T_R_B
    )
    vi_map = map_of(dataclasses.replace(truth, T_R_B=turned))
    # fixes between the vertices
    between = se3.transform(truth.T_R_B[:-1], np.broadcast_to(ARM_I, (len(truth) - 1, 3)))
    middle = 0.5 * (between + p[1:])
    times_ns = (truth.times_ns[:-1] + truth.times_ns[1:]) // 2
    lat, lon, alt = ORIGIN
    flags = {"gps_lever_arm_m": "0.2,-0.1,0.5", "gps_origin": f"{lat},{lon},{alt}"}
    for path in (
        write_csv(tmp_path / "track.csv", times_ns, middle),
        write_nmea(tmp_path / "track.nmea", times_ns, middle),
    ):
        with Session() as session:
            session.maps.add("walk", vi_map)
            report: Any = session.run("import_gps", gps_file=path, **flags)
            after = session.vi_map
            assert report.median_error_m < 1e-3
            np.testing.assert_allclose(after.T_G_I[:, 4:], truth.T_R_B[:, 4:], atol=2e-3)
            table = after.absolute_poses
            np.testing.assert_allclose(table.T_G_S[:, 4:], p[table.vertex], atol=2e-3)
            assert table.covariance[0, 5, 5] == 1e6
            with pytest.raises(UserError, match="--gps_replace"):
                session.run("import_gps", gps_file=path, **flags)
            session.run("import_gps", gps_file=path, gps_replace=True)  # the map's origin
            assert gps.origin_of(session.vi_map) == ORIGIN
            session.run("undo")
            assert session.vi_map is after


def test_a_map_has_one_origin_and_known_missions_move_along(tmp_path: Path) -> None:
    first, later = loop(60, 2, 20.0), loop(60, 2, 20.0)
    later = dataclasses.replace(later, times_ns=later.times_ns + 10**12)
    vi_map = merge.merge_maps(map_of(first), map_of(later))[0]
    known = np.ones(2, dtype=np.bool_)
    vi_map = vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=known))
    missions = [vi_map.mission(row).id[:8] for row in range(2)]
    moved = first.T_R_B[:, 4:] + np.array([100.0, 50.0, 2.0])
    files = [
        write_csv(tmp_path / f"{row}.csv", walk.times_ns, moved)
        for row, walk in enumerate((first, later))
    ]
    with Session() as session:
        session.maps.add("two", vi_map)
        session.run("import_gps", gps_file=files[0], map_mission=missions[0])
        np.testing.assert_allclose(session.vi_map.T_G_M[0], session.vi_map.T_G_M[1], atol=1e-9)
        flags = {"gps_file": files[1], "map_mission": missions[1]}
        with pytest.raises(UserError, match="another origin"):
            session.run("import_gps", **flags, gps_origin="47,8,0")
        before = session.vi_map
        session.run("import_gps", **flags)
        np.testing.assert_allclose(session.vi_map.T_G_M, before.T_G_M, atol=1e-6)
        assert gps.origin_of(session.vi_map) == gps.origin_of(before)


def test_nmea_of_every_kind(tmp_path: Path) -> None:
    times_ns = START_NS + np.arange(4) * 200_000_000
    p = np.arange(12.0).reshape(4, 3)
    track = read_gps(write_nmea(tmp_path / "a.nmea", times_ns, p))
    np.testing.assert_array_equal(track.times_ns, times_ns)
    np.testing.assert_allclose(track.altitude_m, 450.0 + p[:, 2], atol=1e-3)
    path = write_nmea(tmp_path / "b.nmea", times_ns, p, with_date=False)
    with pytest.raises(UserError, match="--gps_date"):
        read_gps(path)
    day = dt.datetime.fromtimestamp(START_NS // 10**9, tz=dt.UTC)
    np.testing.assert_array_equal(read_gps(path, f"{day:%Y-%m-%d}").times_ns, times_ns)
    with pytest.raises(UserError, match="YYYY-MM-DD"):
        read_gps(path, "yesterday")
    lines = (tmp_path / "a.nmea").read_text().splitlines()
    lines[1] = lines[1].replace("GGA,", "GGA,9")
    no_fix = sentence("GPGGA,000000.00,,,,,0,00,,,M,,M,,")
    path.write_text("\n".join([no_fix, *lines, lines[-1][:20]]))
    track = read_gps(path)
    assert (len(track), dict(track.left_out)) == (3, {"without a fix": 1, "damaged": 2})
    # midnight without dates
    late = [
        f"GPGGA,{clock},4700.0,S,00800.0,W,1,9,1.0,1.0,M,,M,," for clock in ("235959", "000001")
    ]
    path.write_text("\n".join(map(sentence, late)))
    track = read_gps(path, "2024-02-29")
    assert np.diff(track.times_ns).tolist() == [2_000_000_000]
    assert (track.latitude_deg[0], track.longitude_deg[0]) == (-47.0, -8.0)


@pytest.mark.parametrize(
    ("text", "left_out"),
    [
        (
            "t,lat,lon,alt\n1,47,8,0\n" + "".join(f"{t},0,0,0\n" for t in range(2, 11)),
            "latitude 0, longitude 0",
        ),
        ("t,lat,lon,alt\n1,47,8,0\n2,95,8,0\n3,47,8,0\n", "beyond 90 or 180 deg"),
        ("t,lat,lon,alt\n1,nan,nan,nan\n2,,,\n3,47,8,0\n", "not a finite number"),
        ("t,lat,lon,alt\n1,47,8,0\n1,47,8,0\n2,47,8,0\n", "repeated"),
        ("t,lat,lon,alt,fix_type\n1,47,8,0,3\n2,46,8,0,0\n", "without a fix (quality 0)"),
        (
            "%time,field.header.frame_id,field.status.status,field.latitude,field.longitude,field.altitude\n"
            "1400000000000000000,gps,0,47,8,0\n1400000001000000000,gps,-1,46,8,0\n",
            "without a fix (status -1)",
        ),
    ],
)
def test_rows_that_are_no_fixes_are_counted_by_reason(
    text: str, left_out: str, tmp_path: Path
) -> None:
    path = tmp_path / "track.csv"
    path.write_text(text)
    track = read_gps(path)
    assert list(dict(track.left_out)) == [left_out]
    assert set(track.latitude_deg.tolist()) == {47.0}
    assert len(track) + sum(dict(track.left_out).values()) == text.count("\n") - 1


def clock(text: str) -> str:
    return sentence(f"GPGGA,{text},4700.0,N,00800.0,E,1,9,1.0,1.0,M,0.0,M,,")


def test_days_follow_the_hours(tmp_path: Path) -> None:
    path = tmp_path / "night.nmea"
    dated = "GPRMC,{},A,4700.0,N,00800.0,E,0.0,0.0,{},,,A"
    first_rmc_after_midnight = [
        clock("235958"),
        clock("235959"),
        sentence(dated.format("000000", "010324")),
        clock("000000"),
    ]
    void = [
        sentence(dated.format("235957", "060180").replace(",A,4700", ",V,4700")),
        *first_rmc_after_midnight,
    ]
    over_two = [
        sentence(dated.format("235958", "290224")),
        clock("235958"),
        clock("235959"),
        clock("000000"),
    ]
    for lines in (first_rmc_after_midnight, void, over_two):
        path.write_text("\n".join(lines))
        stamps = [dt.datetime.fromtimestamp(t / 1e9, dt.UTC) for t in read_gps(path).times_ns]
        assert [f"{t:%d %H:%M:%S}" for t in stamps] == ["29 23:59:58", "29 23:59:59", "01 00:00:00"]
    later = [
        sentence(dated.format("120000", "010324")),
        clock("120000"),
        sentence(dated.format("120000", "040324")),
        clock("120000"),
    ]
    path.write_text("\n".join(later))
    assert np.diff(read_gps(path).times_ns).tolist() == [3 * 86_400 * 10**9]


def test_sentences_of_other_programs(tmp_path: Path) -> None:
    path, day = tmp_path / "log.txt", "2024-03-01"
    lines = [clock("120000"), clock("120001.5")]
    wanted = [43_200_000_000_000, 43_201_500_000_000]
    others = {
        "text before": [f"2024-03-01 12:00:00.123 [gps] {line}" for line in lines],
        "lower-case sums": [line[:-2] + line[-2:].lower() for line in lines],
        "lower case": [line.lower() for line in lines],
        "no sums": [line[:-3] for line in lines],
        "no sums and a cut line": [*(line[:-3] for line in lines), "$GPGGA,120002,4700.0"],
    }
    for name, texts in others.items():
        path.write_text("\n".join(texts))
        track = read_gps(path, day)
        assert (track.times_ns - track.times_ns[0] + wanted[0]).tolist() == wanted, name
        assert dict(track.left_out) == ({"damaged": 1} if "cut" in name else {}), name
    path.write_bytes(b"\xb5\x62\x01\x07\xff" + "\r\n".join(lines).encode() + b"\xb5\x62\xfe\n")
    assert len(read_gps(path, day)) == 2
    path.write_text("\n".join([*lines, lines[0][:-3]]))  # one sum lacks where others have one
    assert dict(read_gps(path, day).left_out) == {"damaged": 1}


def test_dates_of_zda_and_fixes_of_gns(tmp_path: Path) -> None:
    path = tmp_path / "track.nmea"
    zda = [sentence(f"GNZDA,12000{k}.00,14,11,2023,00,00") for k in range(3)]
    unset = [sentence(f"GNZDA,12000{k}.00,06,01,1980,00,00") for k in range(3)]
    rmc = [sentence(f"GNRMC,12000{k},A,4700.0,N,00800.0,E,0,0,141123,,,A") for k in range(3)]
    gga = [clock(f"12000{k}.00") for k in range(3)]
    gns = "GNGNS,12000{}.00,4700.0,N,00800.0,E,{},9,1.0,1.0,46.0,,"
    modes = [sentence(gns.format(k, "NN" if k == 1 else "RN")) for k in range(3)]
    wrapped = [f'17000000{k},"{line}"' for k, line in enumerate([*rmc, *gga])]
    for lines, count in (
        ([*zda, *gga], 3),
        ([unset[0], *zda[1:], *gga], 3),
        ([*rmc, *modes], 2),
        ([*rmc, *gga, *modes], 3),
        (["time,sentence", *wrapped], 3),
    ):
        path.write_text("\n".join(lines))
        track = read_gps(path)
        assert len(track) == count
        assert track.times_ns[0] == 1699963200_000_000_000
        assert dict(track.left_out) == ({} if count == 3 else {"without a fix": 1})
    assert track.altitude_m[0] == 1.0
    path.write_text("\n".join([*rmc, *modes]))
    assert read_gps(path).altitude_m[0] == 47.0
    path.write_text("\n".join([*rmc, sentence("GNGLL,4700.0,N,00800.0,E,120000.00,A,A")]))
    with pytest.raises(MaplabError, match="no GGA or GNS sentences"):
        read_gps(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no rows"),
        ("1.0,2.0\n", "no positions"),
        ("t,lat,lon\n1,47,8\n", "no positions"),
        ("t,lat,lon,alt\n1,473769000,85417000,0\n", "wants degrees"),
        ("t,lat,lon,alt\n1,0.826,0.149,0\n2,0.826,0.149,0\n", "radians"),
        ("t,lat,lon,alt\n2,47,8,0\n1,47,8,0\n", ":3: is not after the one before"),
        ("t,lat,lon,alt\n1,47,8,0\n1,47,9,0\n", r":3: has the stamp .* of the fix before it \(2\)"),
        ("t,lat,lon,alt\n1,0,0,0\n2,0,0,0\n", "no fixes: 2 latitude 0, longitude 0"),
        ("t,lat,lon,alt,status\n1,47,8,0,-1\n2,47,8,0,-1\n", r"2 without a fix \(status -1\)"),
        ("t,lat,lon,alt\n1,47,8,nan\n", "not a finite number"),
        ("t,lat,lon,alt\n1,47,8,0\n2,47,8\n", "columns"),
        ("$GPGGA,12", "no fixes"),
        ("t,lat,lon,alt\n1,47,8,0\n2,47,8,0\n", "at the time of the mission"),
    ],
)
def test_wrong_files(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.csv"
    path.write_text(text)
    with Session() as session:
        session.maps.add("walk", map_of(loop(10, 2)))
        before = session.vi_map
        with pytest.raises(MaplabError, match=message) as error:
            session.run("import_gps", gps_file=path)
        assert "wrong.csv" in str(error.value)
        assert "\n" not in str(error.value)
        assert session.vi_map is before


@pytest.mark.parametrize(
    "flags",
    [
        {"gps_lever_arm_m": "1,2"},
        {"gps_origin": "100,0,0"},
    ],
)
def test_wrong_flags_are_named(flags: dict[str, Any], tmp_path: Path) -> None:
    with Session() as session:
        session.maps.add("walk", map_of(loop(10, 2)))
        with pytest.raises(MaplabError, match=f"--{next(iter(flags))}"):
            session.run("import_gps", gps_file=tmp_path / "track.csv", **flags)


def test_deviations_that_are_too_small_leave_no_measurement_out() -> None:
    truth = loop(100, 2)
    vi_map = map_of(truth)
    rows = np.arange(0, len(truth), 2)
    rng = np.random.default_rng(3)
    poses = np.array(truth.T_R_B[rows])
    poses[:, 4:] += 0.5 * rng.standard_normal((len(rows), 3))
    poses[7, 4:] += 20.0
    table = AbsolutePoses.filled(
        len(rows),
        vertex=rows,
        timestamp_ns=truth.times_ns[rows],
        T_G_S=poses,
        covariance=np.tile(np.eye(6) * 1e-6, (len(rows), 1, 1)),  # 1 mm, and the truth is 0.5 m
    )
    vi_map = vi_map.replace(absolute_poses=table)
    at_body = se3.identity(len(rows))
    found = absolute_outliers(vi_map, np.arange(len(rows)), at_body, 5.0)
    assert np.flatnonzero(found).tolist() == [7]
    assert not absolute_outliers(vi_map, np.arange(len(rows)), at_body, 0.0).any()
    few = absolute_outliers(vi_map, np.arange(6, 9), at_body[:3], 5.0)
    assert not few.any()
