"""Write docs/self_calibration_results.md and its picture from what evaluate_self_calibration.py measured.

python docs/scripts/self_calibration_page.py --results=ar_room.jsonl --consistency=clean.jsonl,swaps.jsonl

Files of consistency are labelled with what follows the first _ of their names.
Beside NAME.jsonl, NAME_vio.jsonl of evaluate_calibrated_odometry.py and NAME_announced.jsonl of
announce_self_calibration.py are read where there are any.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from evaluate_self_calibration import lines_of
from numpy.typing import NDArray

F64 = NDArray[np.float64]

DOCS = Path(__file__).resolve().parents[1]
THESIS = {
    "focal length": (0.35, 1.0, "px"),
    "centre": (0.7, 1.0, "px"),
    "distortion": (5e-4, 1.0, ""),
    "gyroscope scale": (1e-3, 1.0, ""),
    "accelerometer scale": (2.5e-3, 1.0, ""),
    "gyroscope misalignment": (1e-3, 1.0, ""),
    "accelerometer misalignment": (5e-3, 1.0, ""),
    "accelerometer rotation": (0.15, float(np.rad2deg(1.0)), "deg"),
    "camera position": (3.0, 1e3, "mm"),
    "camera rotation": (0.07, float(np.rad2deg(1.0)), "deg"),
}
"""Level of the thesis' table 6.1, factor to its unit, unit."""
FEW_SETS = 3
"""With fewer data sets there is no deviation over them to speak of."""

INTRODUCTION = """# Self-calibration: results

Made by `docs/scripts/evaluate_self_calibration.py` and `self_calibration_page.py`: simulated sessions
of one device with an unknown calibration, beginning at the nominal one. The thesis' numbers are of
recordings with a real tablet, without truth; here the errors are against truth.

What the scenario takes from the thesis: sensors, rates and camera, the room, sessions of 2 min with
stationary and rotation-only phases and slow, minor translation (section 7.6.2, AR/VR), and calm
sections beside ones that excite all degrees of freedom (section 6.5). The thesis does not say how
noisy its keypoints were, nor how many: 0.8 px and at most 150 an image are our choice.
"""


def kind_of(name: str) -> str:
    """Return the row of the table that a parameter belongs to."""
    words = name.split()
    if words[0] == "camera" and words[1] in ("position", "rotation"):
        return " ".join(words[:2])
    if words[0] == "camera":
        return "focal length" if words[1] == "focal" else words[1]
    return f"{words[0]} {words[1] if words[1] == 'rotation' else words[2]}"


def levels(names: list[str]) -> F64:
    """Return the thesis' deviation (k,) of every parameter, in the parameters' units."""
    return np.array([THESIS[kind_of(name)][0] / THESIS[kind_of(name)][1] for name in names])


def overall(row: dict[str, Any]) -> float:
    """Return the error of a calibration: root mean square in units of the thesis' deviations."""
    return float(np.sqrt(np.mean((np.array(row["error"]) / levels(row["names"])) ** 2)))


class Results:
    """Rows of one scenario, by method."""

    def __init__(self, rows: list[dict[str, Any]], odometry: list[dict[str, Any]]) -> None:
        """Sort rows, and errors of odometry that used the calibrations, by method and data set."""
        self.odometry_m = {(row["set"], row["method"]): row["vio_m"] for row in odometry}
        self.map_m = {row["method"]: row["map_m"] for row in rows if row["set"] < 0}
        self.by_method: dict[str, dict[int, dict[str, Any]]] = {}
        for row in rows:
            if row["set"] >= 0:
                self.by_method.setdefault(row["method"], {})[row["set"]] = row

    def pairs(self, one: str, other: str) -> list[tuple[dict[str, Any], dict[str, Any]]]:
        """Return the rows of data sets that both methods have."""
        first, second = self.by_method.get(one, {}), self.by_method.get(other, {})
        return [(first[k], second[k]) for k in sorted(first.keys() & second.keys())]

    def spread(self, method: str, sets: list[int]) -> F64:
        """Return the standard deviation (k,) of every parameter's error over data sets."""
        rows = self.by_method[method]
        return np.asarray(np.std([rows[k]["error"] for k in sets], axis=0, ddof=1))

    def spread_ratio(self, one: str, other: str) -> F64:
        """Return the ratio (k,) of the spreads of two methods over the data sets of both."""
        sets = sorted(self.by_method[one].keys() & self.by_method[other].keys())
        return self.spread(one, sets) / self.spread(other, sets)


def odometry_lines(results: Results) -> list[str]:
    """Return the rows on odometry with the calibrations, in the thesis' way."""
    errors_m, lines = results.odometry_m, []
    best = "8: A-optimality"
    for other in ("8: random", "8: least informative"):
        sets = [k for k, name in errors_m if name == best and (k, other) in errors_m]
        if not sets:
            continue
        own, worse = (np.array([errors_m[k, name] for k in sets]) for name in (best, other))
        what = other.removeprefix("8: ")
        lines.append(
            f"| error of odometry, 8 informative over {what} ({len(sets)} sets) | "
            f"{'0.23-0.55' if 'random' in what else 'worse'} | "
            f"{np.median(own) / np.median(worse):.2f} ({1e3 * np.median(own):.0f} mm over "
            f"{1e3 * np.median(worse):.0f} mm; true calibration {1e3 * errors_m[-1, 'truth']:.0f} mm, "
            f"nominal {1e3 * errors_m[-1, 'nominal']:.0f} mm); {what} worse in "
            f"{np.mean(worse > own):.0%} of sets |"
        )
    return lines


def consistency_table(paths: list[Path]) -> list[str]:
    """Return the section on errors and announced deviations."""
    lines = [
        "## Are the errors as large as announced?",
        "",
        "Full batches of 26 s that excite everything, other motion and noise each time. The NEES is",
        "the squared error in units of the announced covariance, 26 on average if that is right.",
        "",
        "| swapped tracks | seeds | NEES | 95 % band | bias [sigma], rms | expected by chance | "
        "spread [sigma], rms | noise factor (true 1) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for path in paths:
        rows = lines_of(path)
        if not rows:
            continue
        error = np.array([row["error"] for row in rows])
        normalised = error / np.array([row["sigma"] for row in rows])
        n, k = error.shape
        label = f" ({path.stem.split('_', 1)[1].replace('_', ' ')})" if "_" in path.stem else ""
        band = 1.96 * np.sqrt(2.0 * k / n)
        mean, deviation = normalised.mean(axis=0), normalised.std(axis=0, ddof=1)
        lines.append(
            f"| {100 * rows[0]['swaps']:.0f} %{label} | {n} | {np.mean([r['nees'] for r in rows]):.1f} | "
            f"{k - band:.1f} .. {k + band:.1f} | {np.sqrt(np.mean(mean**2)):.2f} "
            f"(largest {np.abs(mean).max():.2f}) | {1 / np.sqrt(n):.2f} | "
            f"{np.sqrt(np.mean(deviation**2)):.2f} | "
            f"{np.mean([r['noise_factor'] for r in rows]):.3f} |"
        )
    return [*lines, ""]


def quality_table(results: Results) -> list[str]:
    """Return one line per method."""
    lines = [
        "### Methods",
        "",
        "| segments taken | sets | number | CPU time [s] | NEES (of 26) | error (thesis = 1) | "
        "map error [mm] |",
        "|---|---|---|---|---|---|---|",
    ]
    for method, by_set in results.by_method.items():
        rows = list(by_set.values())
        judged = [1e3 * row["map_m"] for row in rows if row["map_m"] is not None]
        map_mm = f"{np.median(judged):.1f}" if judged else ""
        lines.append(
            f"| {method} | {len(rows)} | {np.median([r['segments'] for r in rows]):.0f} | "
            f"{np.median([r['cpu_s'] for r in rows]):.1f} | "
            f"{np.nanmedian([r['nees'] for r in rows]):.0f} | "
            f"{np.median([overall(r) for r in rows]):.2f} | {map_mm} |"
        )
    known = ", ".join(
        f"{1e3 * value:.1f} mm with the {name.replace('truth', 'true')}"
        for name, value in results.map_m.items()
    )
    lines += [
        "",
        "Medians. Error: root mean square over all parameters, each in units of its deviation in the",
        "thesis' table 6.1. Map error: position error of another session of 30 s (0.5 m/s), optimised",
        f"with the calibration held; {known} calibration.",
        "",
    ]
    return lines


def parameter_table(results: Results) -> list[str]:
    """Return errors and spreads of the parameters."""
    methods = [
        m
        for m in ("informative", "batch", "8: A-optimality", "8: random")
        if m in results.by_method
    ]
    names = next(iter(results.by_method[methods[0]].values()))["names"]
    lines = [
        "### Parameters: standard deviation over the data sets (root mean square error)",
        "",
        "| parameter | unit | thesis | " + " | ".join(methods) + " |",
        "|---|---|---|" + "---|" * len(methods),
    ]
    for kind, (level, factor, unit) in THESIS.items():
        own = [k for k, one in enumerate(names) if kind_of(one) == kind]
        cells = []
        for method in methods:
            error = (
                factor * np.array([r["error"] for r in results.by_method[method].values()])[:, own]
            )
            cell = f"({np.sqrt(np.mean(error**2)):.2g})"
            if len(error) >= FEW_SETS:
                cell = f"{np.sqrt(np.mean(error.var(axis=0, ddof=1))):.2g} {cell}"
            cells.append(cell)
        lines.append(f"| {kind} | {unit} | {level:.2g} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def comparison_table(results: Results) -> list[str]:
    """Return what is compared with the thesis' claims."""
    lines = ["### Against the thesis' claims", "", "| what | thesis | here |", "|---|---|---|"]

    def add(what: str, thesis: str, here: str) -> None:
        lines.append(f"| {what} | {thesis} | {here} |")

    if len(results.pairs("informative", "batch")) >= FEW_SETS:
        ratio = results.spread_ratio("informative", "batch")
        add(
            "spread of the parameters, informative over batch",
            "median 2.1, largest 3.3",
            f"median {np.median(ratio):.2f}, largest {ratio.max():.2f}",
        )
    floor = results.map_m.get("truth", 0.0)
    for other in ("8: random", "8: least informative"):
        pairs = results.pairs("8: A-optimality", other)
        if not pairs:
            continue
        a, b = (
            np.array([row[k] for row in side])
            for side, k in zip(zip(*pairs, strict=True), ("map_m",) * 2, strict=True)
        )
        own, worse = (np.array([overall(row) for row in side]) for side in zip(*pairs, strict=True))
        excess = np.median(np.sqrt(np.maximum(a**2 - floor**2, 0.0))) / np.median(
            np.sqrt(np.maximum(b**2 - floor**2, 1e-12))
        )
        claim = "0.23-0.55" if "random" in other else "worse"
        add(
            f"map error, 8 informative over {other.removeprefix('8: ')}",
            claim,
            f"{np.median(a) / np.median(b):.2f}; without what the true calibration leaves, "
            f"{excess:.2f}; {other.removeprefix('8: ')} worse in {np.mean(b > a):.0%} of sets",
        )
        add(
            f"error of the parameters, 8 informative over {other.removeprefix('8: ')}",
            "",
            f"{np.median(own) / np.median(worse):.2f}; worse in {np.mean(worse > own):.0%} of sets",
        )
    lines += odometry_lines(results)
    for groups, single, what in (
        ("4 each: entropy by groups", "4: entropy", "tables of 4, entropy"),
        ("8 each: entropy by groups", "8: D-optimality", "tables of 8, entropy"),
        ("8: entropy by groups", "8: D-optimality", "8 segments in all, entropy"),
        ("8: A-optimality by groups", "8: A-optimality", "8 segments in all, A-optimality"),
    ):
        if len(pairs := results.pairs(groups, single)) < FEW_SETS:
            continue
        ratio = results.spread_ratio(groups, single)
        names = pairs[0][0]["names"]
        thesis = [
            k for k, n in enumerate(names) if kind_of(n) in ("centre", "gyroscope misalignment")
        ]
        taken = [np.mean([row["segments"] for row in side]) for side in zip(*pairs, strict=True)]
        add(
            f"spread, three groups over a single one, {what} ({taken[0]:.1f} segments against "
            f"{taken[1]:.1f}, {len(pairs)} sets)",
            "0.56-0.60 (centre, gyroscope misalignment)",
            f"median {np.median(ratio):.2f}; these: {np.median(ratio[thesis]):.2f}",
        )
    if len(pairs := results.pairs("informative", "8: A-optimality")) >= FEW_SETS:
        ratio = results.spread_ratio("informative", "8: A-optimality")
        taken = np.mean([row["segments"] for row, _ in pairs])
        add(
            f"spread, the 8 best of each group ({taken:.1f} segments) over a single group of 8",
            "",
            f"median {np.median(ratio):.2f}",
        )
    if len(pairs := results.pairs("two sessions", "batch")) >= FEW_SETS:
        own, batch = (
            np.median([overall(row) for row in side]) for side in zip(*pairs, strict=True)
        )
        ratio = results.spread_ratio("two sessions", "batch")
        add(
            "database after two sessions over batch of one: error, spread",
            "close to 1 (bar 1.3)",
            f"{own / batch:.2f}, median {np.median(ratio):.2f}",
        )
    return [*lines, ""]


def announced_table(rows: list[dict[str, Any]]) -> list[str]:
    """Return how certain selections could be at best, without an estimate."""
    if not rows:
        return []
    by_selection: dict[str, dict[int, dict[str, Any]]] = {}
    for row in rows:
        by_selection.setdefault(row["selection"], {})[row["set"]] = row
    level = levels(rows[0]["names"])
    total = {
        name: {
            k: float(np.sqrt(np.mean((np.array(r["sigma"]) / level) ** 2))) for k, r in own.items()
        }
        for name, own in by_selection.items()
    }
    scale = [k for k, n in enumerate(rows[0]["names"]) if kind_of(n) == "accelerometer scale"]
    tilt_deg = np.median([row["tilt_deg"] for row in rows])
    lines = [
        "### What a selection can hold",
        "",
        "| segments | sets | announced deviations (thesis = 1) | over random | accelerometer scale |",
        "|---|---|---|---|---|",
    ]
    for name, own in by_selection.items():
        ratio = np.median([value / total["8: random"][k] for k, value in total[name].items()])
        sigma = np.median(
            [np.sqrt(np.mean(np.array(r["sigma"])[scale] ** 2)) for r in own.values()]
        )
        lines.append(
            f"| {name} | {len(own)} | {np.median(list(total[name].values())):.2f} | {ratio:.2f} | "
            f"{sigma:.4f} |"
        )
    return [
        *lines,
        "",
        "Medians, from the Jacobians at the true states (`docs/scripts/announce_self_calibration.py`);",
        "nothing is estimated. *Together*: taken one after the other so that all of them make the trace (in",
        "units of the thesis' or of a segment's usual deviations), the determinant, or the variance of the",
        f"accelerometer's scale least. Gravity turns by {tilt_deg:.0f} degrees (rms) as the IMU sees it.",
        "",
    ]


def picture(results: Results) -> str:
    """Return an SVG: the error of every data set by method, on a logarithmic scale."""
    width, row_px, left, right = 720.0, 30.0, 210.0, 20.0
    methods = list(results.by_method)
    values = {m: np.array([overall(r) for r in results.by_method[m].values()]) for m in methods}
    low = np.floor(np.log10(min(v.min() for v in values.values())))
    high = np.ceil(np.log10(max(v.max() for v in values.values())))
    height = 40.0 + row_px * len(methods) + 30.0

    def place(value: float) -> float:
        return left + (np.log10(value) - low) / (high - low) * (width - left - right)

    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        'font-family="sans-serif" font-size="13">',
        f'<rect width="{width:g}" height="{height:g}" fill="#ffffff"/>',
        f'<text x="{width / 2:g}" y="20" text-anchor="middle">Error of the calibration, by data set '
        "(1 = deviations of the thesis, table 6.1)</text>",
    ]
    for decade in range(int(low), int(high) + 1):
        x = place(10.0**decade)
        lines.append(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="32" y2="{height - 26:g}" stroke="#cccccc"/>'
        )
        lines.append(
            f'<text x="{x:.1f}" y="{height - 8:g}" text-anchor="middle">{10.0**decade:g}</text>'
        )
    for number, method in enumerate(methods):
        y = 50.0 + row_px * number
        lines.append(f'<text x="10" y="{y + 4:g}">{method}</text>')
        lines += [
            f'<circle cx="{place(float(v)):.1f}" cy="{y:g}" r="4" fill="#2060a0" fill-opacity="0.5"/>'
            for v in values[method]
        ]
        x = place(float(np.median(values[method])))
        lines.append(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{y - 10:g}" y2="{y + 10:g}" stroke="#c02020" '
            'stroke-width="3"/>'
        )
    return "\n".join([*lines, "</svg>"]) + "\n"


def of_scenario(path: Path) -> list[str]:
    """Return the sections on one scenario; write its picture."""
    results = Results(lines_of(path), lines_of(path.with_name(f"{path.stem}_vio.jsonl")))
    image = f"images/self_calibration_{path.stem}.svg"
    (DOCS / image).write_text(picture(results))
    each = np.median(
        [r["selection_s_per_segment"] for rows in results.by_method.values() for r in rows.values()]
    )
    return [
        f"## Scenario {path.stem}",
        "",
        f"![Error of every data set by method]({image})",
        "",
        *quality_table(results),
        f"Evaluating a segment takes {each:.3f} s of CPU time.",
        "",
        *comparison_table(results),
        *parameter_table(results),
        *announced_table(lines_of(path.with_name(f"{path.stem}_announced.jsonl"))),
    ]


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", default="", help="files, separated by commas")
    parser.add_argument("--consistency", default="", help="files, separated by commas")
    parser.add_argument("--notes", type=Path, help="what to say about the numbers")
    arguments = parser.parse_args()
    lines = [INTRODUCTION]
    paths = [Path(name) for name in arguments.consistency.split(",") if name]
    lines += consistency_table(paths) if paths else []
    for name in filter(None, arguments.results.split(",")):
        lines += of_scenario(Path(name))
    if arguments.notes is not None:
        lines.append(arguments.notes.read_text())
    (DOCS / "self_calibration_results.md").write_text("\n".join(lines).rstrip() + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
