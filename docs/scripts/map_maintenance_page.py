"""The table, the findings and the figure of docs/map_maintenance.md, from what was measured."""

import dataclasses

import numpy as np

FRACTIONS = (0.0, 0.5, 0.75, 0.9, 0.95, 0.98)
METHODS = ("ilp", "most_observed", "random")
COLOURS = {"ilp": "#7db8e8", "most_observed": "#b8400e", "random": "#555555"}
NAMES = {"ilp": "integer programme", "most_observed": "most observed", "random": "random"}
_WANTED_SHARE = 0.85
_WIDTHS = {"ilp": 7.0, "most_observed": 3.0, "random": 1.5}
_LEFT, _TOP, _WIDTH, _HEIGHT, _GAP = 70.0, 36.0, 370.0, 300.0, 70.0


@dataclasses.dataclass(frozen=True)
class Point:
    """One map variant."""

    keyframed: bool
    pruned: float
    method: str
    landmarks: int
    observations: int
    maplab_megabytes: float | None  # maplab's fields only, as exact as it writes them
    megabytes: float | None  # our file
    queries: int
    recall: float
    wrong: int
    median_error_m: float


def table(points: list[Point]) -> list[str]:
    """Return the lines of the table: keyframed maps in brackets, a dash where nothing was measured."""
    lines = [
        "| pruned | landmarks | MB as maplab writes it | MB as we write it | recall: integer "
        "programme | most observed | random |",
        "|---|---|---|---|---|---|---|",
    ]
    for pruned in FRACTIONS:
        pair = [_find(points, keyframed, pruned, METHODS[0]) for keyframed in (False, True)]
        cells = [f"{100 * pruned:.0f} %"]
        cells.append(_cell([str(p.landmarks) if p else None for p in pair]))
        cells.append(_cell([_megabytes(p.maplab_megabytes) if p else None for p in pair]))
        cells.append(_cell([_megabytes(p.megabytes) if p else None for p in pair]))
        for method in METHODS:
            found = [_find(points, keyframed, pruned, method) for keyframed in (False, True)]
            cells.append(_cell([f"{100 * p.recall:.1f} %" if p else None for p in found]))
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _cell(values: list[str | None]) -> str:
    return f"{values[0] or '-'} ({values[1] or '-'})"


def _megabytes(value: float | None) -> str | None:
    return None if value is None else f"{value:.3f}"


def _find(points: list[Point], keyframed: bool, pruned: float, method: str) -> Point | None:
    """Return a variant; without pruning all methods are the same."""
    wanted = (keyframed, pruned, method if pruned else METHODS[0])
    found = [p for p in points if (p.keyframed, p.pruned, p.method) == wanted]
    return found[0] if found else None


def plot(points: list[Point]) -> str:
    """Return the figure as SVG: recall over the pruned part, a panel for each kind of map.

    Lines lie upon each other where choices do equally well, so they differ in width: what is drawn
    later is narrower.
    """
    size = 'width="900" height="420" viewBox="0 0 900 420"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="13">',
        '<rect width="100%" height="100%" fill="white"/>',
        f'<text transform="translate(20,{_TOP + _HEIGHT / 2}) rotate(-90)" text-anchor="middle">'
        "queries localised within 0.5 m [%]</text>",
    ]
    for keyframed, title in ((False, "all keyframes"), (True, "keyframed")):
        left = _LEFT + keyframed * (_WIDTH + _GAP)
        lines += _axes(left, title)
        for method in METHODS:
            found = [_find(points, keyframed, pruned, method) for pruned in FRACTIONS]
            lines += _line([p for p in found if p is not None], left, method)
    for number, method in enumerate(METHODS):
        x, y = _LEFT + 190 * number, _TOP + _HEIGHT + 68
        lines.append(f'<path d="M{x} {y} h34" {_stroke(method)}/>')
        lines.append(_marker(x + 17.0, y, method))
        lines.append(f'<text x="{x + 42}" y="{y + 5}">{NAMES[method]}</text>')
    return "\n".join([*lines, "</svg>", ""])


def _axes(left: float, title: str) -> list[str]:
    middle = left + _WIDTH / 2
    lines = [f'<text x="{middle}" y="22" text-anchor="middle" font-weight="bold">{title}</text>']
    for step in range(0, 101, 20):
        y = _TOP + _HEIGHT * (1.0 - step / 100.0)
        lines.append(f'<path d="M{left} {y:.1f} h{_WIDTH}" stroke="#dddddd"/>')
        lines.append(f'<text x="{left - 8}" y="{y + 5:.1f}" text-anchor="end">{step}</text>')
    for pruned in FRACTIONS:
        x = _x(left, pruned)
        lines.append(f'<path d="M{x:.1f} {_TOP + _HEIGHT} v5" stroke="#888888"/>')
        y = _TOP + _HEIGHT + 20
        lines.append(f'<text x="{x:.1f}" y="{y}" text-anchor="middle">{100 * pruned:.0f}</text>')
    y = _TOP + _HEIGHT + 42
    lines.append(f'<text x="{middle}" y="{y}" text-anchor="middle">landmarks pruned [%]</text>')
    return lines


def _line(points: list[Point], left: float, method: str) -> list[str]:
    at = [(_x(left, p.pruned), _TOP + _HEIGHT * (1.0 - p.recall)) for p in points]
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in at)
    lines = [f'<polyline points="{path}" fill="none" {_stroke(method)}/>']
    return lines + [_marker(x, y, method) for x, y in at]


def _x(left: float, pruned: float) -> float:
    """Return where a pruned part is drawn.

    The axis is the logarithm of what is kept, so that 98 % is not squeezed into a corner.
    """
    return float(left + _WIDTH * np.log(1.0 - pruned) / np.log(1.0 - FRACTIONS[-1]))


def _stroke(method: str) -> str:
    return f'stroke="{COLOURS[method]}" stroke-width="{_WIDTHS[method]}" stroke-linejoin="round"'


def _marker(x: float, y: float, method: str) -> str:
    radius = 2.5 + 0.5 * _WIDTHS[method]
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{COLOURS[method]}"/>'


def findings(points: list[Point]) -> list[str]:
    """Return what the measurements say, in sentences."""
    whole, thin = (_find(points, keyframed, 0.0, METHODS[0]) for keyframed in (False, True))
    lines = []
    if whole and thin:
        lines.append(
            f"- Keyframing alone makes maplab's file {_ratio(whole, thin, maplab=True):.1f} times "
            f"smaller and ours {_ratio(whole, thin):.1f} times, and costs "
            f"{_points(whole, thin)} points of recall."
        )
        lines += _at_90_percent(points, whole) + _smallest(points, whole)
    queries = max(point.queries for point in points)
    wrong = sum(point.wrong for point in points)
    answers = sum(point.queries for point in points)
    lines.append(
        f"- Of {answers} queries in all variants together, {wrong} were answered wrong by more "
        "than 0.5 m. "
        f"One of {queries} queries more or less changes recall by {100 / queries:.1f} points."
    )
    return lines


def _at_90_percent(points: list[Point], whole: Point) -> list[str]:
    """Tell how small the keyframed map is with a tenth of its landmarks."""
    small = _find(points, True, 0.9, METHODS[0])
    if small is None:
        return []
    return [
        f"- Keyframed and pruned by 90 %, maplab's file is {_ratio(whole, small, maplab=True):.1f} "
        f"times smaller, ours {_ratio(whole, small):.1f} times, and it keeps "
        f"{100 * small.recall / whole.recall:.1f} % of the recall."
    ]


def _smallest(points: list[Point], whole: Point) -> list[str]:
    """Name the smallest map that keeps the wanted part of the recall."""
    enough = [
        p for p in points if p.method == METHODS[0] and p.recall >= _WANTED_SHARE * whole.recall
    ]
    best = min(enough, key=lambda p: p.megabytes or np.inf)
    how = "keyframed and " if best.keyframed else ""
    return [
        f"- The smallest map that keeps {100 * _WANTED_SHARE:.0f} % of the recall is {how}pruned by "
        f"{100 * best.pruned:.0f} %: maplab's file is {_ratio(whole, best, maplab=True):.0f} times "
        f"smaller, ours {_ratio(whole, best):.0f} times, and it keeps "
        f"{100 * best.recall / whole.recall:.0f} % of the recall (Schneider 2019: 13 times, 85 %)."
    ]


def _ratio(whole: Point, small: Point, *, maplab: bool = False) -> float:
    if maplab:
        return (whole.maplab_megabytes or np.nan) / (small.maplab_megabytes or np.nan)
    return (whole.megabytes or np.nan) / (small.megabytes or np.nan)


def _points(before: Point, after: Point) -> str:
    return f"{100 * (before.recall - after.recall):.1f}"
