"""Scenarios in YAML: those that come along load; a mistake is one line that names file and key."""

import dataclasses
from pathlib import Path

import pytest

from maplab_py.errors import UserError
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.scenario_file import load_scenario, parse_scenario, scenario_names


@pytest.mark.parametrize("name", scenario_names())
def test_named_scenarios_load(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.name == name
    assert scenario.description


def test_a_file_overrides_what_it_names(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("name: mine\nimu: {rate_hz: 400}\nsessions: [{kind: loop, turns: 2}]\n")
    scenario = load_scenario(path)
    assert scenario.imu.rate_hz == 400.0
    assert scenario.imu.gravity_mps2 == 9.81
    assert scenario.sessions[0].kind == "loop"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("imu: {rate_herz: 200}", r"imu.rate_herz: unknown key; did you mean 'rate_hz'\?"),
        ("imu: {rate_hz: fast}", "imu.rate_hz: a number is expected, not 'fast'"),
        ("imu: {rate_hz: true}", "imu.rate_hz: a number is expected, not True"),
        ("imu: {rate_hz: -1}", "imu.rate_hz: must be above 0, not -1"),
        ("imu: {rate_hz: .nan}", "imu.rate_hz: must be a number up to 1e.06, not nan"),
        ("imu: 3", "imu: a mapping of keys is expected, not 3"),
        ("[1, 2]", "the file: a mapping of keys is expected"),
        ("", "the file: a mapping of keys is expected, not None"),
        ("seeds: {world: 1.5}", "seeds.world: a whole number is expected, not 1.5"),
        ("seeds: {world: -1}", "seeds.world: must be at least 0"),
        ("world: {room_size_m: [1, 2]}", "world.room_size_m: 3 values are expected, not 2"),
        ("world: {room_size_m: 3}", "world.room_size_m: a list is expected, not 3"),
        ("sessions: []", "sessions: at least one is needed"),
        ("cameras: []", "cameras: at least one is needed"),
        ("sessions: [{kind: jump}]", r"sessions\[0\].kind: must be one of room_scan"),
        ("sessions: [{}, {duraton_s: 3}]", r"sessions\[1\].duraton_s: unknown key; did you mean"),
        ("sessions: [{duration_s: 0}]", r"sessions\[0\].duration_s: too short"),
        ("sessions: [{reverse: 1}]", r"sessions\[0\].reverse: true or false is expected, not 1"),
        ("sessions: [{height_m: 3.4}]", r"sessions\[0\].height_m: leads through"),
        ("sessions: [{wall_distance_m: 5}]", r"sessions\[0\].wall_distance_m: leaves no room"),
        ("cameras: [{distortion: fish}]", r"cameras\[0\].distortion: must be one of none"),
        ("cameras: [{intrinsics: [1]}]", r"cameras\[0\].intrinsics: 4 values are expected, not 1"),
        (
            "world: {layout: tower}",
            "world.layout: must be one of rooms, corridor, city, not 'tower'",
        ),
        ("world: {layout: corridor, corridor_width_m: 3}", "world.corridor_width_m: must not"),
        (
            "world: {layout: corridor, corridor_width_m: 2}",
            r"sessions\[0\].kind: room_scan needs world.layout: rooms",
        ),
        ("sessions: [{kind: corridor}]", r"sessions\[0\].kind: corridor needs world.layout"),
        ("sessions: [{room: 1}]", r"sessions\[0\].room: must be from 0 to 0"),
        ("sessions: [{device: -1}]", r"sessions\[0\].device: must be at least 0"),
        ("sessions: [{shake_hz: 0}]", r"sessions\[0\].shake_hz: must be above 0"),
        (
            "sessions: [{phases: [{}, {duraton_s: 1}]}]",
            r"sessions\[0\].phases\[1\].duraton_s: unknown key; did you mean",
        ),
        ("sessions: [{phases: [{turns: 0}]}]", r"sessions\[0\].phases\[0\].turns: must not be 0"),
        ("calibration: {focal_sigma_px: -1}", "calibration.focal_sigma_px: must be at least 0"),
        ("drift: {baseframe_offset_m: -1}", "drift.baseframe_offset_m: must be at least 0"),
        ("drift: {tilt_sigma_deg: .inf}", "drift.tilt_sigma_deg: must be a number up to"),
        (
            "cameras: [{position_m: [0, .nan, 0]}]",
            r"cameras\[0\].position_m\[1\]: must be a number",
        ),
        ("sessions: [{duration_s: 900000}]", r"sessions\[0\].duration_s: gives more than 10000000"),
        (
            "measurement: {max_view_angle_deg: 91}",
            "measurement.max_view_angle_deg: must be above 0 and at most 90",
        ),
        ("measurement: {min_track_length: 1}", "measurement.min_track_length: must be at least 2"),
        ("imu: {time_offset_s: 0.06}", "imu.time_offset_s: must be at least -0.05"),
        ("imu: {time_jitter_s: 0.01}", "imu.time_jitter_s: must not exceed a tenth"),
        ("cameras: [{line_delay_s: 0.001}]", r"cameras\[0\].line_delay_s: reads longer than"),
        (
            "appearance: {vanish_share: 2}",
            "appearance.vanish_share: must be at least 0 and at most 1",
        ),
        ("measurement: {frame_rate_hz: 500}", "measurement.frame_rate_hz: must not exceed"),
        ("sessions: [{images: {walkers: 1}}]", r"images.walkers: needs images.render: true"),
        ("sessions: [{images: {walkers: 1000}}]", r"images.walkers: must be .* at most 100"),
        ("sessions: [{images: {walkers_until_s: 200000}}]", r"walkers_until_s: must be .* at most"),
        (
            "sessions: [{images: {walkers_from_s: 3, walkers_until_s: 2}}]",
            r"sessions\[0\].images.walkers_until_s: must be after",
        ),
        ("name: [", "line 1: this is not YAML: expected the node content"),
        ("imu: {rate_hz: 1, rate_hz: 2}", "this is not YAML: key 'rate_hz' twice, line 1"),
        ("world:\n\trooms: 1", "line 2: this is not YAML: found character"),
    ],
)
def test_mistakes_name_the_key(text: str, message: str) -> None:
    with pytest.raises(UserError, match=r"^here\.yaml.*" + message) as caught:
        parse_scenario(text, "here.yaml")
    assert "\n" not in str(caught.value)


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(UserError, match=r"no scenario 'nowhere'.*three_sessions"):
        load_scenario("nowhere")


def test_small_numbers_may_be_written_with_an_exponent() -> None:
    scenario = parse_scenario("imu: {gyro_noise_density: 1e-4}", "here.yaml")
    assert scenario.imu.gyro_noise_density == 1e-4


def _numbers(kind: type, prefix: str = "") -> list[str]:
    """Return the keys of all numbers of a scenario outside lists."""
    keys = []
    for field in dataclasses.fields(kind):
        value = getattr(kind(), field.name)
        if dataclasses.is_dataclass(value):
            keys += _numbers(type(value), f"{prefix}{field.name}.")
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            keys.append(prefix + field.name)
    return keys


@pytest.mark.parametrize("value", ["some", "null", "true", "[]", "{}", ".nan", ".inf", "1.0e+300"])
def test_no_number_takes_what_is_none(value: str) -> None:
    keys = _numbers(Scenario)
    assert len(keys) > 50
    for key in keys:
        group, name = key.split(".")
        with pytest.raises(UserError, match=rf"^here\.yaml: {group}\.{name}: ") as caught:
            parse_scenario(f"{group}: {{{name}: {value}}}", "here.yaml")
        assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_bytes(b"name: \xff\xfe")
    with pytest.raises(UserError, match=r"cannot read .*bad\.yaml: it is not UTF-8 text"):
        load_scenario(tmp_path / "bad.yaml")
