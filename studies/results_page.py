"""A page of results, self_calibration_results.md, and its pictures, from measured results."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.output_files import write_text
from studies.data_sets import Row, lines_of

FEW_SETS = 3
"""With fewer data sets there is no standard deviation over them."""
_BEST = "8: A-optimality"
_CLAIMS = {"8: random": "0.23-0.55", "8: least informative": "worse"}
"""Ratio of the errors with 8 informative segments and with others (Schneider 2019)."""

_INTRODUCTION = """# Self-calibration: results

Made by `python -m studies`: simulated sessions of one device with an unknown calibration,
starting from the nominal one. The numbers of the thesis (Schneider 2019) are of recordings with a real
tablet, without ground truth; here the errors are against ground truth.

What the scenario takes from the thesis: sensors, rates and camera, the room, sessions of 2 min with
stationary and rotation-only phases and slow, minor translation (section 7.6.2, AR/VR), and calm
sections beside ones that excite all degrees of freedom (section 6.5). The thesis does not say how
noisy its keypoints were, nor how many: 0.8 px and at most 150 an image are our choice.
"""


def write_page(
    results: list[Path], consistency: list[Path], notes: Path | None, docs: Path
) -> None:
    """Write the page and one picture per scenario.

    Args:
        results: Files of `accuracy.measure`. Beside NAME.jsonl, NAME_vio.jsonl of `odometry` and
            NAME_predicted.jsonl of `predicted_deviations` are read where they exist.
        consistency: Files of `accuracy.consistency`; the label is the part of the name after the
            first _.
        notes: Text for the end of the page.
        docs: Folder of the page; the pictures lie in its folder images.
    """
    lines = [_INTRODUCTION, *(_consistency(consistency) if consistency else [])]
    for path in results:
        lines += _scenario(path, docs)
    if notes is not None:
        lines.append(notes.read_text())
    page = "\n".join(lines).rstrip() + "\n"
    write_text(docs / "self_calibration_results.md", [page], overwrite=True)


def _table(header: str, rows: Iterable[Sequence[str]]) -> list[str]:
    """Return a table: the header's columns are separated by |."""
    columns = header.split("|")
    lines = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows), ""]


def _scenario(path: Path, docs: Path) -> list[str]:
    results = Results(lines_of(path), lines_of(path.with_name(f"{path.stem}_vio.jsonl")))
    image = f"images/self_calibration_{path.stem}.svg"
    write_text(docs / image, [picture(results)], overwrite=True)
    every = [row for rows in results.by_method.values() for row in rows.values()]
    each_s = np.median([row["selection_s_per_segment"] for row in every])
    return [
        f"## Scenario {path.stem}",
        "",
        f"![Error of every data set by method]({image})",
        "",
        *_methods(results),
        f"Evaluating a segment takes {each_s:.3f} s of CPU time.",
        "",
        "### Against the thesis' claims",
        "",
        *_table("what|thesis|here", [*_errors(results), *_odometry(results), *_spreads(results)]),
        *_parameters(results),
        *_predictions(lines_of(path.with_name(f"{path.stem}_predicted.jsonl"))),
    ]


def _consistency(paths: list[Path]) -> list[str]:
    """Return the section on errors and reported deviations."""
    cells = []
    for path in paths:
        rows = lines_of(path)
        if not rows:
            continue
        normalised = np.array([row["error"] for row in rows]) / [row["sigma"] for row in rows]
        n, k = normalised.shape
        label = f" ({path.stem.split('_', 1)[1].replace('_', ' ')})" if "_" in path.stem else ""
        band = 1.96 * np.sqrt(2.0 * k / n)
        mean, deviation = normalised.mean(axis=0), normalised.std(axis=0, ddof=1)
        cells.append(
            (
                f"{100 * rows[0]['swaps']:.0f} %{label}",
                f"{n}",
                f"{np.mean([row['nees'] for row in rows]):.1f}",
                f"{k - band:.1f} .. {k + band:.1f}",
                f"{np.sqrt(np.mean(mean**2)):.2f} (largest {np.abs(mean).max():.2f})",
                f"{1 / np.sqrt(n):.2f}",
                f"{np.sqrt(np.mean(deviation**2)):.2f}",
                f"{np.mean([row['noise_factor'] for row in rows]):.3f}",
            )
        )
    return [
        "## Are the errors as large as reported?",
        "",
        "Full batches of 26 s that excite everything, other motion and noise each time. The NEES is",
        "the squared error in units of the reported covariance, 26 on average if that is right.",
        "",
        *_table(
            "swapped tracks|seeds|NEES|95 % band|bias [sigma], rms|expected by chance|"
            "spread [sigma], rms|noise factor (true 1)",
            cells,
        ),
    ]


def _methods(results: Results) -> list[str]:
    """Return the section with a line per method."""
    cells = []
    for method, by_set in results.by_method.items():
        rows = list(by_set.values())
        judged_mm = [1e3 * row["map_m"] for row in rows if row["map_m"] is not None]
        cells.append(
            (
                method,
                f"{len(rows)}",
                f"{np.median([row['segments'] for row in rows]):.0f}",
                f"{np.median([row['cpu_s'] for row in rows]):.1f}",
                f"{np.nanmedian([row['nees'] for row in rows]):.0f}",
                f"{np.median([overall(row) for row in rows]):.2f}",
                f"{np.median(judged_mm):.1f}" if judged_mm else "",
            )
        )
    known = ", ".join(
        f"{1e3 * value:.1f} mm with the {name.replace('truth', 'true')}"
        for name, value in results.map_m.items()
    )
    return [
        "### Methods",
        "",
        *_table(
            "segments taken|sets|number|CPU time [s]|NEES (of 26)|error (thesis = 1)|map error [mm]",
            cells,
        ),
        "Medians. Error: root mean square over all parameters, each in units of its deviation in the",
        "thesis' table 6.1. Map error: position error of another session of 30 s (0.5 m/s), optimised",
        f"with the calibration fixed; {known} calibration.",
        "",
    ]


def _errors(results: Results) -> Iterable[tuple[str, str, str]]:
    """Yield the comparisons of spreads and map errors."""
    if len(results.pairs("informative", "batch")[0]) >= FEW_SETS:
        ratio = results.spread_ratio("informative", "batch")
        yield (
            "spread of the parameters, informative over batch",
            "median 2.1, largest 3.3",
            f"median {np.median(ratio):.2f}, largest {ratio.max():.2f}",
        )
    floor_m = results.map_m.get("truth", 0.0)
    for other, claim in _CLAIMS.items():
        pairs = results.pairs(_BEST, other)
        if not pairs[0]:
            continue
        name = other.removeprefix("8: ")
        a, b = (np.array([overall(row) for row in rows]) for rows in pairs)
        judged = [
            pair for pair in zip(*pairs, strict=True) if None not in (r["map_m"] for r in pair)
        ]
        if judged:
            a_m, b_m = np.array([[row["map_m"] for row in pair] for pair in judged]).T
            excess = np.median(np.sqrt(np.maximum(a_m**2 - floor_m**2, 0.0))) / np.median(
                np.sqrt(np.maximum(b_m**2 - floor_m**2, 1e-12))
            )
            yield (
                f"map error, 8 informative over {name}",
                claim,
                f"{np.median(a_m) / np.median(b_m):.2f}; without what the true calibration leaves, "
                f"{excess:.2f}; {name} worse in {np.mean(b_m > a_m):.0%} of sets",
            )
        yield (
            f"error of the parameters, 8 informative over {name}",
            "",
            f"{np.median(a) / np.median(b):.2f}; worse in {np.mean(b > a):.0%} of sets",
        )


def _odometry(results: Results) -> Iterable[tuple[str, str, str]]:
    """Yield the comparison of odometry with the calibrations."""
    errors_m = results.odometry_m
    for other, claim in _CLAIMS.items():
        sets = [k for k, name in errors_m if name == _BEST and (k, other) in errors_m]
        if not sets:
            continue
        name = other.removeprefix("8: ")
        a, b = (1e3 * np.array([errors_m[k, method] for k in sets]) for method in (_BEST, other))
        true_mm, nominal_mm = (1e3 * errors_m[-1, what] for what in ("truth", "nominal"))
        yield (
            f"error of odometry, 8 informative over {name} ({len(sets)} sets)",
            claim,
            f"{np.median(a) / np.median(b):.2f} ({np.median(a):.0f} mm over {np.median(b):.0f} mm; "
            f"true calibration {true_mm:.0f} mm, nominal {nominal_mm:.0f} mm); {name} worse in "
            f"{np.mean(b > a):.0%} of sets",
        )


def _spreads(results: Results) -> Iterable[tuple[str, str, str]]:
    """Yield the comparisons of groups of parameters, and of two sessions."""
    for groups, single, what in (
        ("4 each: entropy by groups", "4: entropy", "tables of 4, entropy"),
        ("8 each: entropy by groups", "8: D-optimality", "tables of 8, entropy"),
        ("8: entropy by groups", "8: D-optimality", "8 segments in all, entropy"),
        ("8: A-optimality by groups", _BEST, "8 segments in all, A-optimality"),
    ):
        pairs = results.pairs(groups, single)
        if len(pairs[0]) < FEW_SETS:
            continue
        ratio, names = results.spread_ratio(groups, single), pairs[0][0]["names"]
        kinds = ("centre", "gyroscope misalignment")
        of_thesis = [k for k, name in enumerate(names) if kind_of(name) in kinds]
        taken = [np.mean([row["segments"] for row in rows]) for rows in pairs]
        yield (
            f"spread, three groups over a single one, {what} ({taken[0]:.1f} segments against "
            f"{taken[1]:.1f}, {len(pairs[0])} sets)",
            "0.56-0.60 (centre, gyroscope misalignment)",
            f"median {np.median(ratio):.2f}; these: {np.median(ratio[of_thesis]):.2f}",
        )
    rows, _ = results.pairs("informative", _BEST)
    if len(rows) >= FEW_SETS:
        mean = np.mean([row["segments"] for row in rows])
        yield (
            f"spread, the 8 best of each group ({mean:.1f} segments) over a single group of 8",
            "",
            f"median {np.median(results.spread_ratio('informative', _BEST)):.2f}",
        )
    pairs = results.pairs("two sessions", "batch")
    if len(pairs[0]) >= FEW_SETS:
        a, b = (np.median([overall(row) for row in rows]) for rows in pairs)
        ratio = results.spread_ratio("two sessions", "batch")
        yield (
            "database after two sessions over batch of one: error, spread",
            "close to 1 (bar 1.3)",
            f"{a / b:.2f}, median {np.median(ratio):.2f}",
        )


def _parameters(results: Results) -> list[str]:
    """Return the section on errors and spreads of the parameters."""
    candidates = ("informative", "batch", _BEST, "8: random")
    methods = [method for method in candidates if method in results.by_method]
    rows = {method: list(results.by_method[method].values()) for method in methods}
    names = rows[methods[0]][0]["names"] if methods else []
    cells = []
    for kind, (level, factor, unit) in THESIS.items():
        columns = [k for k, name in enumerate(names) if kind_of(name) == kind]
        if not columns:
            continue
        line = [kind, unit, f"{level:.2g}"]
        for method in methods:
            error = factor * np.array([row["error"] for row in rows[method]])[:, columns]
            cell = f"({np.sqrt(np.mean(error**2)):.2g})"
            if len(error) >= FEW_SETS:
                cell = f"{np.sqrt(np.mean(error.var(axis=0, ddof=1))):.2g} {cell}"
            line.append(cell)
        cells.append(line)
    return [
        "### Parameters: standard deviation over the data sets (root mean square error)",
        "",
        *_table("|".join(["parameter", "unit", "thesis", *methods]), cells),
    ]


def _predictions(rows: list[Row]) -> list[str]:
    """Return the section on deviations from the Jacobians, without an estimate."""
    if not rows:
        return []
    by_selection: dict[str, dict[int, Row]] = {}
    for row in rows:
        by_selection.setdefault(row["selection"], {})[row["set"]] = row
    total = {
        name: {k: relative_rms(row["sigma"], row["names"]) for k, row in by_set.items()}
        for name, by_set in by_selection.items()
    }
    scale = [k for k, n in enumerate(rows[0]["names"]) if kind_of(n) == "accelerometer scale"]
    cells = []
    for name, by_set in by_selection.items():
        ratio = [value / total["8: random"][k] for k, value in total[name].items()]
        sigma = [np.sqrt(np.mean(np.array(r["sigma"])[scale] ** 2)) for r in by_set.values()]
        median = np.median(list(total[name].values()))
        cells.append(
            (name, f"{len(by_set)}", f"{median:.2f}", f"{np.median(ratio):.2f}",
             f"{np.median(sigma):.4f}")
        )  # fmt: skip
    tilt_deg = np.median([row["tilt_deg"] for row in rows])
    return [
        "### Deviations that a selection can reach",
        "",
        *_table(
            "segments|sets|deviations (thesis = 1)|over random|accelerometer scale",
            cells,
        ),
        "Medians, from the Jacobians at the true states (`python -m studies predict`);",
        "nothing is estimated. *Together*: selected one after the other for the least trace (in units of",
        "the thesis' or of a segment's usual deviations), determinant, or variance of the",
        "accelerometer's scale of their joint covariance. Gravity turns by "
        f"{tilt_deg:.0f} degrees (rms) in the IMU frame.",
        "",
    ]


_WIDTH, _ROW_PX, _LEFT, _RIGHT = 720.0, 30.0, 210.0, 20.0


def picture(results: Results) -> str:
    """Return an SVG: the error of every data set by method, on a logarithmic scale."""
    values = {
        method: np.array([overall(row) for row in rows.values()])
        for method, rows in results.by_method.items()
    }
    every = np.log10(np.concatenate(list(values.values())))
    low, high = float(np.floor(every.min())), float(np.ceil(every.max()))
    height = 40.0 + _ROW_PX * len(values) + 30.0

    def x_of(value: float) -> float:
        share = (float(np.log10(value)) - low) / max(high - low, 1.0)
        return _LEFT + share * (_WIDTH - _LEFT - _RIGHT)

    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH:g} {height:g}" '
        'font-family="sans-serif" font-size="13">',
        f'<rect width="{_WIDTH:g}" height="{height:g}" fill="#ffffff"/>',
        f'<text x="{_WIDTH / 2:g}" y="20" text-anchor="middle">Error of the calibration, by data set '
        "(1 = deviations of the thesis, table 6.1)</text>",
    ]
    for decade in range(int(low), int(high) + 1):
        x = x_of(10.0**decade)
        lines += [
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="32" y2="{height - 26:g}" stroke="#cccccc"/>',
            f'<text x="{x:.1f}" y="{height - 8:g}" text-anchor="middle">{10.0**decade:g}</text>',
        ]
    for number, (method, errors) in enumerate(values.items()):
        y = 50.0 + _ROW_PX * number
        lines.append(f'<text x="10" y="{y + 4:g}">{method}</text>')
        lines += [
            f'<circle cx="{x_of(error):.1f}" cy="{y:g}" r="4" fill="#2060a0" fill-opacity="0.5"/>'
            for error in errors.tolist()
        ]
        x = x_of(float(np.median(errors)))
        lines.append(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{y - 10:g}" y2="{y + 10:g}" stroke="#c02020" '
            'stroke-width="3"/>'
        )
    return "\n".join([*lines, "</svg>"]) + "\n"


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
"""Deviation of table 6.1, factor to its unit, unit."""


def kind_of(name: str) -> str:
    """Return the row of the table that a parameter belongs to."""
    words = name.split()
    if words[0] == "camera" and words[1] in ("position", "rotation"):
        return " ".join(words[:2])
    if words[0] == "camera":
        return "focal length" if words[1] == "focal" else words[1]
    return f"{words[0]} {words[1] if words[1] == 'rotation' else words[2]}"


def levels(names: Sequence[str]) -> F64:
    """Return the deviation (k,) of every parameter in table 6.1, in the parameters' units."""
    return np.array([THESIS[kind_of(name)][0] / THESIS[kind_of(name)][1] for name in names])


def relative_rms(values: Sequence[float], names: Sequence[str]) -> float:
    """Return the root mean square of errors or deviations (k,) relative to table 6.1."""
    return float(np.sqrt(np.mean((np.array(values) / levels(names)) ** 2)))


def overall(row: Row) -> float:
    """Return the error of a calibration in units of the deviations of table 6.1."""
    return relative_rms(row["error"], row["names"])


class Results:
    """Results of one scenario, by method and data set."""

    def __init__(self, rows: list[Row], odometry: list[Row]) -> None:
        """Sort rows of `accuracy.measure` and of `odometry.measure_odometry`."""
        self.odometry_m = {(row["set"], row["method"]): row["vio_m"] for row in odometry}
        self.map_m = {row["method"]: row["map_m"] for row in rows if row["set"] < 0}
        self.by_method: dict[str, dict[int, Row]] = {}
        for row in rows:
            if row["set"] >= 0:
                self.by_method.setdefault(row["method"], {})[row["set"]] = row

    def pairs(self, method: str, other: str) -> tuple[list[Row], list[Row]]:
        """Return the rows of two methods for the data sets that both have."""
        first, second = self.by_method.get(method, {}), self.by_method.get(other, {})
        common = sorted(first.keys() & second.keys())
        return [first[k] for k in common], [second[k] for k in common]

    def spread_ratio(self, method: str, other: str) -> F64:
        """Return the ratio (k,) of the standard deviations of errors over the common data sets."""
        a, b = (
            np.std([row["error"] for row in rows], axis=0, ddof=1)
            for rows in self.pairs(method, other)
        )
        return np.asarray(a / b)
