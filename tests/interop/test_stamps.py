"""Time stamps as text: exact, in the unit of header or plausibility, or refused by name."""

from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.interop import text_table, trajectories
from maplab_py.interop.stamps import (
    IMAGES,
    IMU,
    POSES,
    StampKind,
    header_unit,
    parse_stamps,
    read_stamps,
)

NOW = 1403715273262142976


def stepped(first: int, step: int, count: int = 20) -> list[str]:
    return [str(first + step * row) for row in range(count)]


@pytest.mark.parametrize(
    ("tokens", "times_ns"),
    [
        (["1403715273262142976.000000", "1403715273312142976.000"], [NOW, NOW + 50_000_000]),
        (["1403715273.262142976", "1403715273.312142976"], [NOW, NOW + 50_000_000]),
        (["1.403715273262142976e+18", "1.403715273312142976e+18"], [NOW, NOW + 50_000_000]),
        (["1403715273262.142976", "1403715273312.142976"], [NOW, NOW + 50_000_000]),
        (["0.0", "0.05", ".1"], [0, 50_000_000, 100_000_000]),
        (["-0.05", "0.", "+0.05"], [-50_000_000, 0, 50_000_000]),
        (["0.0000000005", "0.0000000015", "0.1"], [0, 2, 100_000_000]),  # half to even
    ],
)
def test_no_digit_is_lost(tokens: list[str], times_ns: list[int]) -> None:
    assert parse_stamps(tokens, POSES, "t.txt", custom="s").times_ns.tolist() == times_ns


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("custom", ["s", "ns"])
@pytest.mark.parametrize(
    ("kind", "step_ns"),
    [(IMU, 5_000_000), (IMU, 1_250_000), (IMAGES, 50_000_000), (POSES, 100_000_000)],
)
def test_dates_tell_the_unit(kind: StampKind, step_ns: int, custom: str, unit: str) -> None:
    scale = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}[unit]
    times_ns = NOW // 1000 * 1000 + step_ns * np.arange(20)
    tokens = [f"{t // scale}.{t % scale:0{len(str(scale)) - 1}d}" for t in times_ns.tolist()]
    if unit == "ns":
        tokens = [token.split(".")[0] for token in tokens]
    stamps = parse_stamps(tokens, kind, "t.txt", custom=custom)
    assert (stamps.unit, stamps.times_ns.tolist()) == (unit, times_ns.tolist())


@pytest.mark.parametrize(
    ("kind", "tokens", "unit"),
    [
        (POSES, stepped(600_000_000_000, 50_000_000), "ns"),
        (POSES, stepped(0, 50_000_000), "ns"),
        (IMU, stepped(262_142, 5_000), "us"),
        (IMU, stepped(0, 5), "ms"),
        (IMAGES, stepped(10_000, 50_000), "us"),
        (IMAGES, stepped(0, 33), "ms"),
    ],
)
def test_clocks_since_boot_are_told_by_their_rate(
    kind: StampKind, tokens: list[str], unit: str
) -> None:
    assert parse_stamps(tokens, kind, "t.txt").unit == unit


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("#timestamp [ns]", "ns"),
        ("t(us)", "us"),
        ("time_ms", "ms"),
        ("stamp (Seconds)", "s"),
        ("t [µs]", "us"),
        ("nsec", "ns"),
        ("timestamps", ""),
        ("t", ""),
        ("status", ""),
    ],
)
def test_units_of_headers(name: str, unit: str) -> None:
    assert header_unit(name) == unit


def test_the_unit_of_a_header_holds(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    pose = "1,2,3,1,0,0,0"
    header = "#timestamp [{}], p_x [m], p_y [m], p_z [m], q_w, q_x, q_y, q_z\n"
    path.write_text(header.format("ns") + f"0,{pose}\n50000000,{pose}\n100000000,{pose}\n")
    assert trajectories.read_trajectory(path).times_ns.tolist() == [0, 50_000_000, 100_000_000]
    path.write_text(header.format("us") + f"1700000000000000,{pose}\n1700000001000000,{pose}\n")
    assert np.diff(trajectories.read_trajectory(path).times_ns).tolist() == [10**9]
    path.write_text(
        "# stamps in microseconds\n" + header.format("").replace("[]", "") + f"7,{pose}\n"
    )
    assert trajectories.read_trajectory(path).times_ns.tolist() == [7000]


def test_names_hold_wherever_their_line_stands() -> None:
    names = "# timestamp [ms] x y\n"
    rows = "1 2 3\n3 4 5\n"
    for text in (
        names + "# made by a robot\n" + rows,
        "# a b c\n" + names + "#\n" + rows,
        rows + names,
    ):
        table = text_table.parse_text_table(text, "t.txt")
        assert table.header == ("timestamp", "x", "y")
        assert table.times_ns.tolist() == [1_000_000, 3_000_000]


def test_a_header_that_no_sensor_can_fulfil_is_said() -> None:
    stamps = parse_stamps(stepped(NOW // 1000, 5000), IMU, "imu.csv", header="#timestamp [ns]")
    assert stamps.unit == "us"
    assert stamps.note == (
        "imu.csv: time stamps are read as us: in ns, as its header says, rows would be 5 us apart"
    )


@pytest.mark.parametrize(
    ("tokens", "words"),
    [
        (["1.4e+18", "1.4e+18", "1.41e18"], "'1.4e[+]18' is rounded.*--time_unit"),
        (["1.403715273e+09", "1.403715274e+09"], "rounded"),
        (["1700000000000000"], "of one time .* --time_unit"),
        (["0", "2", "4"], "open: rows are 2 s in s, 2 ms in ms.*--time_unit=s.ms.us.ns"),
        (["1", "later"], "t.txt:2: 'later' is not a time stamp"),
        (["1", "nan"], "not a time stamp"),
        (["1", "1_000"], "not a time stamp"),
        (["1", "9" * 30], "beyond 64 bits"),
        (["1", "1e400"], "beyond 64 bits"),
    ],
)
def test_nothing_is_guessed(tokens: list[str], words: str) -> None:
    with pytest.raises(MapError, match=words) as caught:
        parse_stamps(tokens, POSES, "t.txt")
    assert "\n" not in str(caught.value)


def test_flags_decide() -> None:
    late = stepped(1_000_000, 2, 1000)
    assert parse_stamps(late, POSES, "t", unit="us").times_ns[0] == 10**9
    with pytest.raises(MapError, match="beyond 64 bits in s"):
        parse_stamps([str(NOW)], POSES, "t", unit="s")


def test_files_of_stamps(tmp_path: Path) -> None:
    path = tmp_path / "times.txt"
    path.write_text("0.000000e+00\n1.037359e-01\n2.074337e-01\n")
    assert read_stamps(path, POSES).times_ns.tolist() == [0, 103_735_900, 207_433_700]
    path.write_text("\n".join(stepped(NOW, 50_000_000)))
    assert read_stamps(path, POSES).times_ns[:2].tolist() == [NOW, NOW + 50_000_000]
    path.write_text("# only\n")
    with pytest.raises(MapError, match="no time stamps"):
        read_stamps(path, POSES)
