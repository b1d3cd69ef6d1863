"""Scenarios in YAML: those that come along load; a mistake is one line that names file and key."""

from __future__ import annotations

from pathlib import Path

import pytest

from maplab_py.errors import UserError
from maplab_py.simulation.scenario_file import load_scenario, parse_scenario, scenario_names


@pytest.mark.parametrize("name", scenario_names())
def test_named_scenarios_load(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.name == name
    assert scenario.description


def test_there_are_the_promised_scenarios() -> None:
    assert {"single_session", "three_sessions", "four_sessions"} <= set(scenario_names())


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
        ("imu: {rate_hz: fast}", "imu.rate_hz: a number is wanted, not 'fast'"),
        ("imu: {rate_hz: true}", "imu.rate_hz: a number is wanted, not True"),
        ("imu: {rate_hz: -1}", "imu.rate_hz: must be greater than 0, not -1"),
        ("imu: {rate_hz: .nan}", "imu.rate_hz: must be greater than 0, not nan"),
        ("imu: 3", "imu: a mapping of keys is wanted, not 3"),
        ("[1, 2]", "the file: a mapping of keys is wanted"),
        ("", "the file: a mapping of keys is wanted, not None"),
        ("seeds: {world: 1.5}", "seeds.world: a whole number is wanted, not 1.5"),
        ("seeds: {world: -1}", "seeds.world: must be 0 or greater"),
        ("world: {room_size_m: [1, 2]}", "world.room_size_m: 3 values are wanted, not 2"),
        ("world: {room_size_m: 3}", "world.room_size_m: a list is wanted, not 3"),
        ("sessions: []", "sessions: at least one is needed"),
        ("cameras: []", "cameras: at least one is needed"),
        ("sessions: [{kind: jump}]", r"sessions\[0\].kind: must be one of room_scan"),
        ("sessions: [{}, {duraton_s: 3}]", r"sessions\[1\].duraton_s: unknown key; did you mean"),
        ("sessions: [{duration_s: 0}]", r"sessions\[0\].duration_s: too short"),
        ("sessions: [{reverse: 1}]", r"sessions\[0\].reverse: true or false is wanted, not 1"),
        ("sessions: [{height_m: 3.4}]", r"sessions\[0\].height_m: leads through"),
        ("sessions: [{wall_distance_m: 5}]", r"sessions\[0\].wall_distance_m: leaves no room"),
        ("cameras: [{distortion: fish}]", r"cameras\[0\].distortion: must be one of none"),
        ("cameras: [{intrinsics: [1]}]", r"cameras\[0\].intrinsics: 4 values are wanted, not 1"),
        ("appearance: {vanish_share: 2}", "appearance.vanish_share: must be between 0 and 1"),
        ("measurement: {frame_rate_hz: 500}", "measurement.frame_rate_hz: must not exceed"),
        ("name: [", "line 1: this is not YAML"),
    ],
)
def test_mistakes_name_the_key(text: str, message: str) -> None:
    with pytest.raises(UserError, match=r"^here\.yaml.*" + message) as caught:
        parse_scenario(text, "here.yaml")
    assert "\n" not in str(caught.value)


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(UserError, match=r"no scenario 'nowhere'.*three_sessions"):
        load_scenario("nowhere")
