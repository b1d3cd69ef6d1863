"""The doctor of maps: a sound map has no red light, each planted fault its own."""

import json
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure import closure_record
from maplab_py.algorithms.loop_closure.reports import Verdict as ClosureVerdict
from maplab_py.algorithms.map_health import MapHealth, map_health
from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.vimap import VIMap
from tests.algorithms.test_scale_check import scaled
from tests.simulation.small import simulated


def lights(vi_map: VIMap) -> dict[str, str]:
    return {light.check: light.light for light in map_health(vi_map).lights}


def test_a_sound_map_has_no_red_light() -> None:
    found = lights(simulated().maps[0])
    assert "red" not in found.values()
    assert found["consistency"] == found["bias of the gyroscope"] == found["coverage"] == "green"
    assert found["disk"] == found["loop closures"] == "grey"


def _biased(vi_map: VIMap) -> VIMap:
    bias = vi_map.vertices.accel_bias + np.array([0.0, 2.0, 0.0])
    return vi_map.replace(vertices=vi_map.vertices.replace(accel_bias=bias))


def _restless(vi_map: VIMap) -> VIMap:
    bias = vi_map.vertices.gyro_bias.copy()
    bias[::2] += 0.05
    return vi_map.replace(vertices=vi_map.vertices.replace(gyro_bias=bias))


def _moved(vi_map: VIMap) -> VIMap:
    p_I = vi_map.landmarks.p_I * 1.2
    return vi_map.replace(landmarks=vi_map.landmarks.replace(p_I=p_I))


def _broken(vi_map: VIMap) -> VIMap:
    T_M_I = vi_map.vertices.T_M_I.copy()
    T_M_I[3] = np.nan
    return vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T_M_I))


@pytest.mark.parametrize(
    ("plant", "check"),
    [
        (_biased, "bias of the accelerometer"),
        (_restless, "change of the biases"),
        (_moved, "bad landmarks"),
        (_broken, "consistency"),
    ],
)
def test_a_planted_fault_has_a_red_light_and_a_remedy(
    plant: Callable[[VIMap], VIMap], check: str
) -> None:
    health = map_health(plant(simulated().maps[0]))
    (red,) = (light for light in health.lights if light.check.startswith(check))
    assert red.light == "red"
    (finding,) = (f for f in health.findings if f.check.startswith(check))
    assert finding.remedy
    assert bool(health.failure) == (check == "consistency")


@pytest.mark.parametrize(
    ("correction_m", "ambiguous", "drift", "places"),
    [(0.01, 0, "green", "green"), (0.4, 4, "yellow", "yellow"), (1.0, 7, "red", "red")],
)
def test_drift_and_ambiguous_places_come_from_the_record_of_closures(
    correction_m: float, ambiguous: int, drift: str, places: str
) -> None:
    vi_map = simulated().maps[0]
    codes = [list(ClosureVerdict).index(ClosureVerdict.AMBIGUOUS)] * ambiguous
    closures = closure_record.ClosureRecord.filled(
        9,
        id=vi_map.vertices.id[:9],
        query=vi_map.vertices.id[9:18],
        place=vi_map.vertices.id[:9],
        T_A_B=se3.relative(vi_map.T_G_I[9:18], vi_map.T_G_I[:9]),
        verdict=[*codes, *[0] * (9 - ambiguous)],
        between_m=np.full(9, 20.0),
        correction_m=np.full(9, correction_m),
    )
    found = lights(closure_record.write_record(vi_map, closure_record.LoopRecord(closures)))
    assert (found["drift before closure"], found["ambiguous places"]) == (drift, places)


def test_a_shrunk_map_contradicts_its_accelerometer() -> None:
    (light,) = (x for x in map_health(scaled(0.5)).lights if x.check.startswith("metric scale of"))
    assert light.light == "red"


def test_the_page_is_written_as_html_and_json(tmp_path: Path) -> None:
    session = Session()
    session.maps.add("a", simulated().maps[0])
    report = session.doctor(file=tmp_path / "health.html")
    text = (tmp_path / "health.html").read_text()
    HTMLParser().feed(text)
    assert text.count("<tr>") == len(report.findings) + 1
    session.doctor(file=tmp_path / "health.json")
    content = json.loads((tmp_path / "health.json").read_text())
    assert len(content["findings"]) == len(report.findings)
    assert "&lt;b&gt;" in MapHealth("<b>", ()).as_html()
    with pytest.raises(UserError, match=r"ends in \.html or \.json"):
        session.doctor(file=tmp_path / "health.txt")
    with pytest.raises(UserError, match="overwrite"):
        session.doctor(file=tmp_path / "health.html")


def test_an_empty_map_is_judged() -> None:
    assert map_health(VIMap()).failure == ""
    assert set(lights(VIMap()).values()) == {"green", "grey"}
