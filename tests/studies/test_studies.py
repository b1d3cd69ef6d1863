"""The studies run, continue where they stopped, and make the page of results."""

import dataclasses
import json
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.segments.selection import Evaluation, evaluate
from maplab_py.simulation.scenario import MotionOptions, Scenario, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from studies import accuracy, figures, odometry, predicted_deviations, thesis_tables
from studies.__main__ import main
from studies.data_sets import Row, lines_of
from studies.published import TABLE_72
from studies.selections import METHODS, chosen_segments, joint_designs, rankings
from studies.thesis_tables import FILTER, OFFICE_ROOM, PAPER_III_METHODS
from studies.thesis_tables import METHODS as METHODS_OF_TABLES
from tests.algorithms.self_calibration.scenes import OPTIONS, scene_map

NAMES = [
    "gyroscope x scale",
    "gyroscope xy misalignment",
    "accelerometer z scale",
    "accelerometer yz misalignment",
    "accelerometer rotation about x",
    "camera focal length u",
    "camera centre u",
    "camera distortion w",
    "camera position x",
    "camera rotation about z",
]


@cache
def evaluation() -> Evaluation:
    return evaluate(scene_map(vertices=61, noise=1.0), OPTIONS)


def short_scenario() -> Scenario:
    motion = MotionOptions(
        kind="figure_8",
        duration_s=14.0,
        turns=0.4,
        wall_distance_m=2.6,
        shake_m=0.06,
        shake_rad=0.2,
    )
    return dataclasses.replace(
        load_scenario("ar_room"), sessions=(SessionOptions(phases=(motion,)),)
    )


@pytest.mark.parametrize("method", [m for m in METHODS if m not in ("batch", "two sessions")])
def test_methods_select_segments(method: str) -> None:
    chosen = chosen_segments(evaluation(), method, 0, 2)
    known = {tuple(one.rows) for one in evaluation().segments}
    assert {tuple(rows) for rows in chosen} <= known
    assert 0 < len(chosen) <= 8


def test_the_most_and_the_least_informative_segments_are_at_opposite_ends() -> None:
    order = rankings(evaluation(), "a_optimality", "imu+camera+extrinsics")[0]
    options = {name: chosen_segments(evaluation(), name, 0, 1) for name in
               ("4: A-optimality", "4: least informative")}  # fmt: skip
    rows = [one.rows for one in evaluation().segments]
    for name, wanted in (("4: A-optimality", order[:4]), ("4: least informative", order[-4:])):
        firsts = sorted(int(chosen[0]) for chosen in options[name])
        assert firsts == sorted(int(rows[k][0]) for k in wanted)


def test_joint_designs_are_no_worse_than_single_scores_at_what_they_minimise() -> None:
    found = evaluation()
    prior = np.diag(found.parameters.prior_sigma**-2.0)
    information = [np.linalg.inv(one.covariance) - prior for one in found.segments]

    def log_determinant(chosen: list[int]) -> float:
        total = prior + sum(information[k] for k in chosen)
        return float(-np.linalg.slogdet(total)[1])

    (design,) = [
        chosen[:2]
        for name, chosen in joint_designs(found, found.parameters.prior_sigma).items()
        if name.endswith("determinant")
    ]
    first = rankings(found, "d_optimality", "imu+camera+extrinsics")[0][:2]
    assert log_determinant(design) <= log_determinant(first) + 1e-9


def test_the_page_shows_what_was_measured(tmp_path: Path) -> None:
    results, page = tmp_path / "tables.jsonl", tmp_path / "page.md"
    session = {"method": "session", "length_m": 30.0, "duration_s": 120.0, "angular_degps": 20.0}
    rows = []
    for environment in TABLE_72:
        for number in range(3):
            where = {"environment": environment, "set": number}
            rows.append({**where, **session})
            for method in ("nominal", *METHODS_OF_TABLES, *PAPER_III_METHODS):
                lost = 2.0 if (method, number) == (FILTER, 0) else 0.02
                row: Row = {"method": method, "names": NAMES, "error": [1e-3 * number] * len(NAMES)}
                row |= {"segments": 8, "of_segments": 30, "cpu_s": 2.0, "choice_s": 3.0}
                row |= {"selection_s_per_segment": 0.05, "images": 1000, "vio_m": [0.01, lost]}
                rows.append({**where, **row})
    results.write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert main(["page", f"--results={results}", f"--out={page}"]) == 0
    text = page.read_text()
    assert "; 3 sessions of each environment" in text
    assert "|AR/VR: office room|30 (24)|120 (117)|0.25 (0.2)|20 (20)|" in text
    assert "|1.50 (1.5)|" in text
    assert "|1.50, 1 diverged (1.86)|" in text
    assert "|camera position [mm]|1 (2.7)|1 (1.2)|1 (2.9)|" in text
    assert "|run time [s]|3.5 (31)|5 (396)|2 (178)|" in text
    assert "|odometry, an image|||0.002 (0.003)|" in text


@pytest.mark.slow
def test_a_study_from_the_simulation_to_the_page(tmp_path: Path) -> None:
    scenario, out = short_scenario(), tmp_path / "short.jsonl"
    methods = ["batch", "8: A-optimality", "8: random", "information gain"]
    for _ in range(2):  # the second time everything is there
        accuracy.measure(scenario, range(1), 2, methods, ["batch"], out)
        odometry.measure_odometry(scenario, out, ["batch"], tmp_path / "short_vio.jsonl")
        predicted_deviations.predict(scenario, range(1), tmp_path / "short_predicted.jsonl")
    rows = {row["method"]: row for row in lines_of(out)}
    assert [*rows] == ["nominal", "truth", *methods]
    assert rows["batch"]["map_m"] < 0.5 * rows["nominal"]["map_m"]
    errors_m = {row["method"]: row["vio_m"] for row in lines_of(tmp_path / "short_vio.jsonl")}
    assert errors_m["truth"] < errors_m["nominal"]
    sigma = {
        r["selection"]: np.array(r["sigma"]) for r in lines_of(tmp_path / "short_predicted.jsonl")
    }
    assert np.all(sigma["batch"] <= sigma["8: random"] * (1.0 + 1e-9))


@pytest.mark.slow
def test_tables_are_measured_in_every_environment(tmp_path: Path) -> None:
    out = tmp_path / "tables.jsonl"
    for _ in range(2):  # the second time everything is there
        thesis_tables.measure({OFFICE_ROOM: short_scenario()}, range(1), out)
    rows = {row["method"]: row for row in lines_of(out)}
    assert [*rows] == ["session", "nominal", *METHODS_OF_TABLES, *PAPER_III_METHODS]
    assert max(rows["batch"]["vio_m"]) < 0.5 * min(rows["nominal"]["vio_m"])
    assert rows["session"]["duration_s"] == pytest.approx(14.0, abs=0.2)


@pytest.mark.slow
def test_errors_are_compared_with_deviations(tmp_path: Path) -> None:
    out = tmp_path / "clean.jsonl"
    words = ["consistency", "--sets=1", f"--out={out}"]
    assert main(words) == 0
    (row,) = lines_of(out)
    assert 5.0 < row["nees"] < 60.0
    assert len(row["error"]) == len(row["names"]) == 26
    shutil.copy(out, tmp_path / "again.jsonl")
    assert main(words) == 0
    assert out.read_bytes() == (tmp_path / "again.jsonl").read_bytes()


def test_the_figures_of_the_thesis_have_counterparts(tmp_path: Path) -> None:
    scenario, out = short_scenario(), tmp_path / "figures.svg"
    figures.draw(scenario, range(1), out, walk=scenario)
    drawn = out.read_text()
    for number in ("6.5", "6.8", "6.9", "7.8", "7.9", "7.10", "7.11"):
        assert f"<!-- {number}: " in drawn  # matplotlib names its titles in comments
    assert "nan" not in drawn
