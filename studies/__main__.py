"""Studies of the self-calibration on simulated sessions of one device.

python -m studies measure --scenario=ar_room --sets=15 --out=ar_room.jsonl
python -m studies odometry --results=ar_room.jsonl --out=ar_room_vio.jsonl
python -m studies predict --scenario=ar_room --sets=3 --out=ar_room_predicted.jsonl
python -m studies consistency --sets=50 --swaps=0.03 --out=swaps.jsonl
python -m studies picture --out=docs/images/segment_information.svg
python -m studies figures --sets=3 --out=docs/images/self_calibration_figures.svg
python -m studies borders --sets=4 --out=borders.jsonl
python -m studies joint_ekf --map=FOLDER --out=FOLDER
python -m studies tables --sets=3 --out=tables.jsonl
python -m studies page --results=tables.jsonl --out=docs/studies/self_calibration_tables.md

The first four studies and `tables` append one line per data set and method to a file; a study that was
interrupted continues. All data sets are recorded with the same device; motion, noise and appearance differ.
`picture` draws a session, coloured by information, `figures` counterparts of those of the thesis, and `page`
writes those of its tables. `joint_ekf` calibrates the device of a map by a Kalman filter of motion and
calibration, and saves the map with the result.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from maplab_py.algorithms.self_calibration.drawing import draw
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.segments.selection import segment_information
from maplab_py.output_files import write_text
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.storage.map_saving import save_map
from maplab_py.storage.native import load_map
from studies import (
    accuracy,
    figures,
    joint_ekf,
    odometry,
    predicted_deviations,
    results_page,
    segment_borders,
    thesis_tables,
)
from studies.data_sets import OPTIONS, with_noise
from studies.selections import JUDGED, METHODS


def main(words: Sequence[str] | None = None) -> int:
    """Run a study.

    Args:
        words: Arguments of the command line; None = those of the process.
    """
    given = _parser().parse_args(words)
    if given.study == "page":
        results_page.write_page(given.results, given.out)
        return 0
    if given.study == "joint_ekf":
        _calibrate_by_filter(given.map, given.out)
        return 0
    scenario = load_scenario(given.scenario)
    if given.study == "picture":
        write_text(given.out, [_picture(scenario)], overwrite=True)
        return 0
    if given.study == "odometry":
        odometry.measure_odometry(scenario, given.results, given.methods.split(","), given.out)
        return 0
    sets = range(given.first, given.first + given.sets)
    if given.study == "tables":
        thesis_tables.measure(thesis_tables.environments(), sets, given.out)
        return 0
    if given.study == "figures":
        figures.draw(scenario, sets, given.out)
        return 0
    if given.study == "borders":
        segment_borders.compare(scenario, sets, given.out)
        return 0
    if given.study == "predict":
        predicted_deviations.predict(scenario, sets, given.out)
        return 0
    scenario = with_noise(scenario, given.swaps, given.keypoint_sigma_px, given.imu_noise)
    if given.study == "consistency":
        accuracy.consistency(scenario, sets, given.out)
    else:
        methods, judged = given.methods.split(","), given.judged.split(",")
        per_group = given.segments_per_group
        accuracy.measure(scenario, sets, per_group, methods, judged, given.out)
    return 0


def _picture(scenario: Scenario) -> str:
    """Return an SVG of the first session, coloured by information about the IMU."""
    vi_map = simulate(dataclasses.replace(scenario, sessions=scenario.sessions[:1])).maps[0]
    report, segments = segment_information(vi_map, SelfCalibrationOptions())
    scores = [segment.imu for segment in report.segments]
    return draw(vi_map, segments, scores, f"information about the IMU, scenario {scenario.name}")


def _calibrate_by_filter(map_folder: Path, out: Path) -> None:
    vi_map, _ = load_map(map_folder)
    filtered = joint_ekf.filter_jointly(vi_map, SelfCalibrationOptions())
    sys.stdout.write(f"{filtered.report().as_json()}\n")
    save_map(vi_map.replace(sensors=filtered.sensors), out)


def _parser() -> argparse.ArgumentParser:
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="python -m studies", description=__doc__, formatter_class=formatter
    )
    studies = parser.add_subparsers(dest="study", required=True)
    for name, sets in (
        ("measure", 15),
        ("consistency", 50),
        ("predict", 3),
        ("figures", 3),
        ("borders", 10),
        ("tables", 5),
        ("odometry", 0),
        ("picture", 0),
    ):
        study = studies.add_parser(name)
        study.add_argument("--scenario", default="ar_room")
        study.add_argument("--out", type=Path, required=True)
        if sets:
            study.add_argument("--first", type=int, default=0)
            study.add_argument("--sets", type=int, default=sets)
        if name in ("measure", "consistency"):
            swaps = 0.0 if name == "consistency" else None
            study.add_argument("--swaps", type=float, default=swaps, help="share of swapped tracks")
            study.add_argument("--keypoint_sigma_px", type=float)
            study.add_argument(
                "--imu_noise", type=float, default=1.0, help="multiple of the scenario's noise"
            )
        if name == "measure":
            study.add_argument("--segments_per_group", type=int, default=OPTIONS.segments_per_group)
            study.add_argument("--methods", default=",".join(METHODS))
            study.add_argument(
                "--judged",
                default=",".join(JUDGED),
                help="methods whose calibrations are evaluated on another session",
            )
        if name == "odometry":
            study.add_argument("--results", type=Path, required=True)
            study.add_argument("--methods", default=",".join(JUDGED))
    baseline = studies.add_parser("joint_ekf")
    baseline.add_argument("--map", type=Path, required=True)
    baseline.add_argument("--out", type=Path, required=True)
    page = studies.add_parser("page")
    page.add_argument("--results", type=Path, required=True)
    page.add_argument("--out", type=Path, required=True)
    return parser


if __name__ == "__main__":
    sys.exit(main())
