"""Picture of the errors of all data sets by method, as SVG."""

from __future__ import annotations

import numpy as np

from maplab_py.research.results import Results, overall

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
