"""Trajectories from above, coloured by the information of segments, as SVG (Schneider 2019, figure 7.1)."""

from collections.abc import Sequence

import numpy as np

from maplab_py.array_types import I64
from maplab_py.vimap import VIMap

_SIZE_PX = 640.0
_MARGIN_PX = 40.0
_COLOURS = np.array([[26, 120, 60], [240, 200, 60], [190, 30, 40]], dtype=np.float64)
"""Colours of the most, the medium and the least informative segment."""


def draw(vi_map: VIMap, segments: list[I64], information: Sequence[float], title: str) -> str:
    """Return an SVG of the trajectory; segments (vertex rows) are coloured by rank of their score.

    Args:
        segments: Vertex rows.
        information: Scores (S,); less is more.
        title: Heading.
    """
    p = vi_map.T_G_I[:, 4:6]
    low, high = p.min(axis=0), p.max(axis=0)
    scale = (_SIZE_PX - 2.0 * _MARGIN_PX) / max(float((high - low).max()), 1e-3)
    pixel = np.column_stack(
        [
            _MARGIN_PX + (p[:, 0] - low[0]) * scale,
            _SIZE_PX - _MARGIN_PX - (p[:, 1] - low[1]) * scale,
        ]
    )
    rank = np.empty(len(segments))
    rank[np.argsort(information, kind="stable")] = np.linspace(0.0, 1.0, len(segments))
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_SIZE_PX:g} {_SIZE_PX + 30:g}" '
        'font-family="sans-serif" font-size="14">',
        f'<rect width="{_SIZE_PX:g}" height="{_SIZE_PX + 30:g}" fill="#ffffff"/>',
        f'<text x="{_SIZE_PX / 2:g}" y="24" text-anchor="middle">{title}</text>',
    ]
    for number in np.argsort(-rank, kind="stable").tolist():
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixel[segments[number]])
        lines.append(
            f'<polyline points="{points}" fill="none" stroke="{colour(float(rank[number]))}" '
            'stroke-width="4" stroke-linecap="round"/>'
        )
    lines += _legend()
    right, y = _SIZE_PX - _MARGIN_PX, _SIZE_PX + 12.0
    lines += [
        f'<line x1="{right - scale:.1f}" x2="{right:.1f}" y1="{y:g}" y2="{y:g}" stroke="#333333" '
        'stroke-width="2"/>',
        f'<text x="{right - scale / 2.0:.1f}" y="{y - 5:g}" text-anchor="middle">1 m</text>',
    ]
    return "\n".join([*lines, "</svg>"]) + "\n"


def colour(rank: float) -> str:
    """Return the colour of a rank between 0 (most informative) and 1."""
    position = rank * (len(_COLOURS) - 1)
    first = min(int(position), len(_COLOURS) - 2)
    mixed = _COLOURS[first] + (position - first) * (_COLOURS[first + 1] - _COLOURS[first])
    return "#" + "".join(f"{round(float(part)):02x}" for part in mixed)


def _legend() -> list[str]:
    steps, width = 24, 8.0
    lines = [
        f'<rect x="{_MARGIN_PX + 130 + k * width:g}" y="{_SIZE_PX + 4:g}" width="{width:g}" '
        f'height="12" fill="{colour(k / (steps - 1))}"/>'
        for k in range(steps)
    ]
    y = _SIZE_PX + 15
    lines.append(f'<text x="{_MARGIN_PX:g}" y="{y:g}">most informative</text>')
    right = _MARGIN_PX + 140 + steps * width
    return [*lines, f'<text x="{right:g}" y="{y:g}">least</text>']


def as_csv(segments: list[tuple[str, int, int]], information: Sequence[float]) -> str:
    """Return the CSV file that the viewer reads.

    Args:
        segments: Mission, begin and end [ns] of every segment.
        information: Scores (S,).
    """
    rows = zip(segments, information, strict=True)
    lines = [f"{mission},{start},{end},{score}\n" for (mission, start, end), score in rows]
    return "".join(["mission,start_ns,end_ns,information\n", *lines])
