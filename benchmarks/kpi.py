"""A fixed set of figures over releases: `python -m benchmarks.kpi [NAME ...] [--write]`.

Measures accuracy, and speed as ratios of processor times in one run, so that figures of different
machines and days compare. `--write` stores them as `docs/kpi/VERSION.json` and writes the table of
`docs/benchmarks.md` again. `--compare` measures nothing: it prints figures of the newest file that are
worse than those before it.
"""

import argparse
import dataclasses
import json
import re
import subprocess
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from benchmarks.comparison import compare
from benchmarks.optvi import measure_tango
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from tests.support import data, programs

Figures = dict[str, float]
STORED = data.REPOSITORY / "docs" / "kpi"
PAGE = data.REPOSITORY / "docs" / "benchmarks.md"
_BEGIN, _END = "<!-- figures over releases -->\n", "<!-- end of figures over releases -->\n"
_SHOWN_RELEASES = 4


@dataclasses.dataclass(frozen=True)
class Change:
    """A figure of two releases. All figures are better when they are smaller."""

    name: str
    before: float
    now: float

    @property
    def share(self) -> float:
        """Relative change."""
        return self.now / self.before - 1.0 if self.before > 0.0 else float(self.now > 0.0)

    @property
    def is_regression(self) -> bool:
        """Whether an accuracy became worse by more than 10 %, a ratio by more than 15 %."""
        return self.share > (0.15 if self.name.endswith("_ratio") else 0.10)


def changes(before: Figures, now: Figures) -> list[Change]:
    """Return the figures that both have."""
    return [Change(name, before[name], now[name]) for name in now if name in before]


def stored_releases(folder: Path = STORED) -> list[tuple[str, Figures]]:
    """Return releases with their figures, oldest first.

    Raises:
        ValueError: A file is no JSON object of numbers; the message names it.
    """
    releases = []
    for path in sorted(folder.glob("*.json"), key=lambda file: _numbers(file.stem)):
        try:
            figures = {name: float(x) for name, x in json.loads(path.read_text("utf-8")).items()}
        except (AttributeError, TypeError, ValueError) as error:
            raise ValueError(f"{path}: no JSON object of numbers: {error}") from None
        releases.append((path.stem, figures))
    return releases


def _numbers(release: str) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", release)))


def table(releases: list[tuple[str, Figures]]) -> str:
    """Return the table of the last releases side by side, with the last change."""
    shown = releases[-_SHOWN_RELEASES:]
    lines = [
        "| figure | " + " | ".join(name for name, _ in shown) + " | change |",
        "|---" * (len(shown) + 2) + "|",
    ]
    for name in dict.fromkeys(name for _, figures in shown for name in figures):
        values = [f"{figures[name]:.3g}" if name in figures else "" for _, figures in shown]
        change = ""
        if len(shown) > 1 and name in shown[-1][1] and name in shown[-2][1]:
            change = f"{100 * Change(name, shown[-2][1][name], shown[-1][1][name]).share:+.0f} %"
        lines.append(f"| {name.replace('_', ' ')} | {' | '.join(values)} | {change} |")
    return "\n".join(lines) + "\n"


def regressions(releases: list[tuple[str, Figures]]) -> list[str]:
    """Return a line for each figure of the last release that is worse than in the one before."""
    if len(releases) < 2:
        return []
    (old, before), (new, now) = releases[-2:]
    return [
        f"{each.name}: {each.before:.4g} in {old}, {each.now:.4g} in {new} ({100 * each.share:+.0f} %)"
        for each in changes(before, now)
        if each.is_regression
    ]


def _solvers() -> Figures:
    return {
        f"{kind}_{size}_to_{'Ceres' if kind == 'visual' else 'GTSAM'}_ratio": compare(
            kind, size
        ).cpu_ratio
        for kind in ("visual", "inertial")
        for size in ("small", "medium")
    }


def _tango() -> Figures:
    ours = compare("visual", "small", 1).ours
    return {
        "Tango_optvi_to_visual_small_ratio": measure_tango(3)["cpu_s"]
        / (ours["user_s"] + ours["system_s"])
    }


def _mh_01() -> Figures:
    recording = data.shared_data_folder() / "euroc_mh01_10s"
    session = Session(load_registry())
    session.run("rovioli", str(recording))
    truth = recording / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    report: Any = session.run("evaluate_trajectory", ground_truth=str(truth))
    return {"MH_01_odometry_ate_m": report.ape_m.rmse}


def _v1_01() -> Figures:
    session = Session(load_registry())
    maps = data.shared_data_folder() / "maplab_maps" / "euroc_v1_01"
    session.run("load_merge_all_submaps", maps_folder=str(maps))
    for command in ("optvi", "lc", "optvi"):
        session.run(command)
    truth = data.shared_data_folder() / "ground_truth" / "V1_01_easy.csv"
    report: Any = session.run("evaluate_trajectory", ground_truth=str(truth))
    return {"V1_01_map_ate_m": report.ape_m.rmse}


def _one_room() -> Figures:
    from benchmarks.map_quality import merged, sessions, workflow_figures
    from maplab_py.algorithms.vi_optimization.optimization import optimize
    from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions

    vi_map, truth = sessions("one_room_many_sessions", 1)
    vi_map, _ = optimize(merged(vi_map, keyframed=True), VIOptimizationOptions())
    figures = workflow_figures(vi_map, truth, 1)
    return {
        "one_room_ate_m": figures.ate_m,
        "one_room_landmarks_median_m": figures.median_good_m,
        "one_room_missed_merges_share": 1.0 - figures.recall,
    }


def _city() -> Figures:
    done = subprocess.run(
        [*programs.module_of_tests("benchmarks.city"), "10"],
        capture_output=True,
        text=True,
        check=True,
    )
    return {"city_of_10_ate_m": float(re.findall(r"ate_m ([\d.e+-]+)", done.stdout)[-1])}


def _dense() -> Figures:
    from benchmarks.dense import measure
    from maplab_py.simulation.scenario_file import load_scenario
    from tests.support.stereo_room import StereoRoom

    with tempfile.TemporaryDirectory() as folder:
        room = StereoRoom.simulated(Path(folder) / "room", load_scenario("stereo_room"))
        results = measure(room)
    return {
        "dense_mesh_mean_m": 1e-3 * results["mesh stereo"].mean_mm,
        "dense_surface_missed_share": 1.0 - results["mesh stereo"].within_5_cm,
    }


def _localisation() -> Figures:
    from benchmarks.localization import QUERIES, maps
    from maplab_py.algorithms.localization.database import database_of_map
    from maplab_py.algorithms.localization.localization import queries, query_vertices
    from maplab_py.algorithms.localization.localizer import Localizer, Outcome
    from maplab_py.algorithms.localization.options import LocalizationOptions

    vi_map, session = maps()
    database = database_of_map(vi_map)
    source = query_vertices(session, range(1), database.projection)  # type: ignore[arg-type]
    localizer = Localizer(database, LocalizationOptions())
    answers = [localizer.localize(query) for query in list(queries(source))[:QUERIES]]
    unknown = sum(answer.outcome is not Outcome.LOCALIZED for answer in answers)
    return {"localisation_failed_share": unknown / len(answers)}


PARTS: dict[str, Callable[[], Figures]] = {
    "solvers": _solvers,
    "tango": _tango,
    "mh_01": _mh_01,
    "v1_01": _v1_01,
    "one_room": _one_room,
    "city": _city,
    "dense": _dense,
    "localisation": _localisation,
}
"""Measurements by name; 8 minutes on two cores in all."""


def write_page(releases: list[tuple[str, Figures]], page: Path = PAGE) -> None:
    """Write the table of the last releases into the page, between its two marks."""
    head, rest = page.read_text("utf-8").split(_BEGIN)
    _, tail = rest.split(_END)
    shown = f"\n{table(releases)}\n" if releases else ""
    page.write_text(f"{head}{_BEGIN}{shown}{_END}{tail}", encoding="utf-8")


def store(figures: Figures) -> None:
    """Add figures to those of this release, and write the page."""
    path = STORED / f"{version('maplab-py')}.json"
    before = json.loads(path.read_text("utf-8")) if path.exists() else {}
    STORED.mkdir(exist_ok=True)
    path.write_text(json.dumps({**before, **figures}, indent=1) + "\n", encoding="utf-8")
    write_page(stored_releases())


def main() -> None:
    """Measure, store and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="|".join(PARTS), help="default: all")
    parser.add_argument("--write", action="store_true", help="store the figures, write the page")
    parser.add_argument("--compare", action="store_true", help="compare stored figures only")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(PARTS):
        parser.error(f"cannot measure {', '.join(sorted(unknown))}; choose from {', '.join(PARTS)}")
    for name in [] if arguments.compare else arguments.names or PARTS:
        figures = PARTS[name]()
        print(json.dumps(figures, indent=1), flush=True)
        if arguments.write:
            store(figures)
    for line in regressions(stored_releases(STORED)):
        print("worse:", line)


if __name__ == "__main__":
    main()
