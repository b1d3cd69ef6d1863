"""The page of results: counterparts of tables 6.1 to 7.5 of Schneider 2019, with its figures in brackets."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from maplab_py.output_files import write_text
from studies import published
from studies.data_sets import Row, lines_of
from studies.published import THESIS, kind_of
from studies.thesis_tables import BATCH, CLASS_ROOM, FILTER, METHODS, OFFICE_ROOM, PAPER_III_METHODS

_ANSWER = (
    "For the selection of segments yes: with eight informative ones errors of odometry are those with all "
    "data, with random ones\n2 to 8 times as large. The joint filter is less accurate than in the thesis."
)
_LIMITS = "Deviations over so few are uncertain by half. Run times are of another processor."
_SHOWS = {
    "6.1": "Informative segments scatter hardly more than all data (thesis: twice as much). Information gain "
    "stops at the first eight\nabove its threshold, and scatters far more.",
    "6.2": "Groups gain nothing here, although they keep 11 segments instead of 8.",
    "6.3": "Information gain takes nearly four times as long as scores of single segments "
    "(thesis: 13 times).",
    "7.1": "The same as in the thesis, by number of dimensions:",
    "7.2": "The simulated office building has straight corridors with few turns, where selection matters "
    "most.",
    "7.3": "Selected segments do as well as all data by every criterion, as in the thesis; random ones are "
    "worse, most in sessions\nwith little excitation. The filter diverges in four of nine sessions, which "
    "begin at rest or on the spot.",
    "7.4": "Eight segments scatter hardly more than all data (thesis: 2 to 40 times).",
    "7.5": "Calibrating on eight segments takes a quarter of the time of all data (thesis: 0.45).",
}
"""Sentence on every table."""
DIVERGED_M = 1.0
"""Odometry that is farther off than this has diverged."""
_BEST, _SINGLE_GROUP = "8: A-optimality", "8: D-optimality"
_INFORMATIVE, _GROUPS, _GAIN = PAPER_III_METHODS
_HEAD = """# Self-calibration results: tables of the thesis

**Question.** Do the tables of the thesis (Schneider 2019) come out the same here?

**Answer.** {answer}

**Limits.** Simulated; {sessions} sessions of each environment, two evaluation sessions of 30 s
(thesis: 3 to 15; 15). {limits}

**Scripts.** `python -m studies tables`, `page`. In brackets: the thesis.

<!-- made by `python -m studies page`; do not edit -->
"""


def write_page(results: Path, page: Path) -> None:
    """Write the page of a file of `thesis_tables.measure`."""
    measured = Results(lines_of(results))
    text = _HEAD.format(sessions=measured.sessions, answer=_ANSWER, limits=_LIMITS)
    for number, (title, table) in _TABLES.items():
        lines = [f"\n## {number} {title}\n", _SHOWS[number], "", *table(measured)]
        text += "\n".join(lines).rstrip() + "\n"
    write_text(page, [text], overwrite=True)


class Results:
    """Lines of results by environment and method."""

    def __init__(self, rows: list[Row]) -> None:
        """Sort the lines."""
        self._rows: dict[tuple[str, str], list[Row]] = {}
        for row in rows:
            self._rows.setdefault((row["environment"], row["method"]), []).append(row)
        self.environments = list(dict.fromkeys(environment for environment, _ in self._rows))

    @property
    def sessions(self) -> str:
        """The numbers of sessions that all methods have calibrated."""
        counts = {len(self.of(each, FILTER)) for each in self.environments}
        return " or ".join(str(count) for count in sorted(counts))

    def of(self, environment: str, method: str) -> list[Row]:
        """Return the lines of a method."""
        return self._rows[environment, method]

    def spread(self, environment: str, method: str, kind: str) -> float:
        """Return the deviation of the errors of a kind of parameters over the sessions, in its unit.

        Sessions after which odometry diverges do not count; nan = fewer than two others.
        """
        rows = [row for row in self.of(environment, method) if max(row["vio_m"]) < DIVERGED_M]
        if len(rows) < 2:
            return float("nan")
        columns = [k for k, name in enumerate(rows[0]["names"]) if kind_of(name) == kind]
        error = np.array([row["error"] for row in rows])[:, columns]
        return THESIS[kind][1] * float(np.sqrt(np.mean(error.var(axis=0, ddof=1))))

    def median(self, method: str, value: Callable[[Row], float], only: str = "") -> float:
        """Return the median of a value over the sessions of all environments, or of one."""
        environments = [only] if only else self.environments
        return float(
            np.median([value(row) for each in environments for row in self.of(each, method)])
        )


def _table(header: str, cells: Iterable[Sequence[str]]) -> list[str]:
    """Return a table: the header's columns are separated by |."""
    lines = [f"|{header}|", "|---" * (header.count("|") + 1) + "|"]
    return [*lines, *(f"|{'|'.join(row)}|" for row in cells)]


def _beside(ours: float, thesis: float | None) -> str:
    return f"{_number(ours)} ({'-' if thesis is None else _number(thesis)})"


def _number(value: float) -> str:
    if np.isnan(value):
        return "diverged"
    return f"{value:.2g}" if abs(value) < 10.0 else f"{value:.0f}"


def _spreads(
    environment: str, figures: published.Figures, *methods: str
) -> Callable[[Results], list[str]]:
    """Return what makes a table of deviations over the sessions; without figures nothing is estimated."""

    def table(results: Results) -> list[str]:
        cells = []
        for kind, thesis in figures.items():
            pairs = zip(methods, thesis, strict=True)
            values = [
                "" if value is None else _beside(results.spread(environment, method, kind), value)
                for method, value in pairs
            ]
            unit = THESIS[kind][2]
            cells.append([f"{kind} [{unit}]" if unit else kind, *values])
        return _table("|".join(["", *methods]), cells)

    return table


def _parameters(results: Results) -> list[str]:
    names = results.of(OFFICE_ROOM, BATCH)[0]["names"]
    kinds = [kind_of(name) for name in names]
    counts = ", ".join(f"{kind} {kinds.count(kind)}" for kind in dict.fromkeys(kinds))
    return [f"{counts}."]


def _run_times(results: Results) -> list[str]:
    methods = (_INFORMATIVE, _GAIN, BATCH)
    rows = {
        "segments": [results.median(m, lambda row: row["segments"], OFFICE_ROOM) for m in methods],
        "run time [s]": [results.median(m, _run_time_s, OFFICE_ROOM) for m in methods],
    }
    return _table("|".join(["", *methods]), _rows_beside(rows, published.TABLE_63))


def _run_time_s(row: Row) -> float:
    """Return the time [s] of selection and calibration."""
    score_s = row["selection_s_per_segment"] * row["of_segments"]
    selection_s = {_INFORMATIVE: score_s, _GAIN: row.get("choice_s", 0.0)}
    return float(selection_s.get(row["method"], 0.0) + row["cpu_s"])


def _rows_beside(
    rows: dict[str, list[float]], figures: published.Figures
) -> Iterable[Sequence[str]]:
    for name, ours in rows.items():
        yield name, *(_beside(*pair) for pair in zip(ours, figures[name], strict=True))


def _sessions(results: Results) -> list[str]:
    rows = {}
    for environment in results.environments:
        each = results.of(environment, "session")
        length_m, duration_s, turn_degps = (
            float(np.mean([row[key] for row in each]))
            for key in ("length_m", "duration_s", "angular_degps")
        )
        rows[environment] = [length_m, duration_s, length_m / duration_s, turn_degps]
    header = "|length [m]|duration [s]|speed [m/s]|turn rate [deg/s]"
    return _table(header, _rows_beside(rows, published.TABLE_72))


def _odometry(results: Results) -> list[str]:
    methods = ("nominal", *METHODS)
    cells = []
    for environment in results.environments:
        line = [environment]
        for method, thesis in zip(methods, published.TABLE_73[environment], strict=True):
            error_m = np.array([row["vio_m"] for row in results.of(environment, method)])
            is_lost = (error_m > DIVERGED_M).any(axis=1)
            if is_lost.all():
                line.append(f"diverged ({thesis:g})")
                continue
            lost = f", {np.count_nonzero(is_lost)} diverged" if is_lost.any() else ""
            line.append(f"{100.0 * np.median(error_m[~is_lost]):.2f}{lost} ({thesis:g})")
        cells.append(line)
    return _table("|".join(["", *methods]), cells)


def _times(results: Results) -> list[str]:
    calibration = [results.median(method, lambda row: row["cpu_s"]) for method in (_BEST, BATCH)]
    image_s = results.median(FILTER, lambda row: row["cpu_s"] / row["images"])
    selection_s = results.median(_BEST, lambda row: row["selection_s_per_segment"])
    of_thesis = published.TABLE_75
    rows = [
        ("odometry, an image", [None, None, image_s]),
        ("selection, a segment", [selection_s, None, None]),
        ("calibration, a session", [*calibration, None]),
    ]
    cells = [
        [
            name,
            *(
                "" if s is None else _beside(s, t)
                for s, t in zip(ours, of_thesis[name], strict=True)
            ),
        ]
        for name, ours in rows
    ]
    return _table(f"[s]|{_BEST}|{BATCH}|{FILTER}", cells)


_TABLES: dict[str, tuple[str, Callable[[Results], list[str]]]] = {
    "6.1": (
        "Deviations over the sessions",
        _spreads(OFFICE_ROOM, published.TABLE_61, _INFORMATIVE, BATCH, _GAIN),
    ),
    "6.2": (
        "Groups of parameters",
        _spreads(OFFICE_ROOM, published.TABLE_62, _GROUPS, _SINGLE_GROUP, BATCH),
    ),
    "6.3": ("Run time", _run_times),
    "7.1": ("Parameters", _parameters),
    "7.2": ("Sessions", _sessions),
    "7.3": ("Error of odometry [cm]", _odometry),
    "7.4": (
        "Deviations over the sessions",
        _spreads(CLASS_ROOM, published.TABLE_74, _BEST, BATCH, FILTER),
    ),
    "7.5": ("Run time", _times),
}
