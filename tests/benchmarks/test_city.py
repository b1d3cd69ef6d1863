"""The city of the benchmark: walks that meet, sessions that are kept, merges that are counted as wrong."""

import numpy as np
import pytest

from benchmarks.city.joint import merges_of_strangers, stage_of
from benchmarks.city.sessions import city_scenario, read_truth, sizes, write_sessions
from maplab_py.simulation.scenario import SessionOptions
from maplab_py.simulation.scenario_file import check_scenario
from maplab_py.simulation.world import pitch_m
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap, edits


def _streets(session: SessionOptions) -> set[tuple[int, int, int, int]]:
    """Return the pieces of streets along the rectangle of a walk, each with its direction."""
    (left, low), (right, high) = session.first_block, session.last_block
    ahead = -1 if session.reverse else 1
    pieces = {(column, low, ahead, 0) for column in range(left, right + 1)}
    pieces |= {(column, high + 1, -ahead, 0) for column in range(left, right + 1)}
    pieces |= {(right + 1, row, 0, ahead) for row in range(low, high + 1)}
    return pieces | {(left, row, 0, -ahead) for row in range(low, high + 1)}


@pytest.mark.parametrize("missions", [10, 25, 100])
def test_walks_stay_in_the_city_and_are_joined_by_streets(missions: int) -> None:
    scenario = city_scenario(missions)
    check_scenario(scenario)
    columns, rows = scenario.world.blocks
    pitch = pitch_m(scenario.world)
    joined: list[set[tuple[int, int, int, int]]] = []
    walked = 0
    for session in scenario.sessions:
        assert min(session.first_block) >= 0
        assert session.last_block[0] < columns
        assert session.last_block[1] < rows
        blocks = np.subtract(session.last_block, session.first_block) + 1
        length_m = session.turns * 2.0 * float(blocks @ pitch)
        assert 0.8 < length_m / session.duration_s < 1.35
        pieces = _streets(session)
        walked += len(pieces)
        others = [group for group in joined if not group & pieces]
        joined = [*others, pieces.union(*(group for group in joined if group & pieces))]
    assert len(joined) == 1
    assert 2.0 < walked / len(joined[0]) < 6.0  # in the same direction


def test_sessions_are_written_once_and_wrong_merges_are_counted(tmp_path) -> None:
    scenario = city_scenario(2, duration_s=6.0)
    maps = write_sessions(scenario, tmp_path, workers=1)
    written = [(folder / "checksums.sha256").stat().st_mtime_ns for folder in maps]
    assert write_sessions(scenario, tmp_path, workers=1) == maps
    assert [(folder / "checksums.sha256").stat().st_mtime_ns for folder in maps] == written
    assert [vertices for vertices, _ in sizes(maps)] == [19, 19]
    truth = read_truth(tmp_path, 2)
    vi_map: VIMap = load_map(maps[1])[0]
    assert merges_of_strangers(vi_map, truth) == 0
    points = truth.point_G[truth.landmark_point[-len(vi_map.landmarks) :]]
    far = int(np.argmax(np.linalg.norm(points - points[0], axis=1)))
    merged = edits.merge_landmarks(vi_map, np.array([far]), np.array([0]))
    assert merges_of_strangers(merged, truth) == 1


def test_the_stages_are_those_of_the_flags_file() -> None:
    assert stage_of("sessions").each == "maps"
    assert "anchor_all_missions" in stage_of("city").commands
