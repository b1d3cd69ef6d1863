"""Draw docs/images/demo.svg: three simulated sessions before and after the workflow, from above.

python docs/scripts/draw_demo.py
"""

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.console.session.session import Session
from maplab_py.geometry import se3
from maplab_py.geometry.alignment import align_yaw_position
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import VIMap

F64 = NDArray[np.float64]

TARGET = Path(__file__).resolve().parents[1] / "images" / "demo.svg"
COLOURS = ("#0b6fb8", "#c8501e", "#2b8a4b")
PIXELS_PER_METRE = 27.0
PANEL_PX = 420


def _panel(vi_map: VIMap, T_G_map: F64, p_true: F64, title: str, left: float) -> list[str]:
    """Return the drawing of one state of the map, laid on the truth by one motion."""
    lines = [f'<text x="{left + PANEL_PX / 2}" y="24" text-anchor="middle">{title}</text>']
    p_G = se3.transform(T_G_map, vi_map.T_G_I[:, 4:])
    both = np.concatenate([p_G, p_true])[:, :2]
    middle = 0.5 * (both.min(axis=0) + both.max(axis=0))
    landmarks = se3.transform(T_G_map, vi_map.p_G[vi_map.landmarks.quality != 1])
    lines += [
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="0.8" fill="#b9b9b9"/>'
        for x, y in _pixels(landmarks, middle, left)
        if left < x < left + PANEL_PX and 30 < y < PANEL_PX
    ]
    for mission, colour in enumerate(COLOURS):
        own = vi_map.vertices.mission == mission
        lines.append(_line(p_true[own], middle, left, "#777777", 4.0, 0.45))
        lines.append(_line(p_G[own], middle, left, colour, 1.8, 1.0))
    return lines


def _pixels(p_G: F64, middle: F64, left: float) -> F64:
    centre = np.array([left + PANEL_PX / 2, 30 + PANEL_PX / 2 - 15])
    return np.asarray(centre + (p_G[:, :2] - middle) * np.array([1.0, -1.0]) * PIXELS_PER_METRE)


def _line(p_G: F64, middle: F64, left: float, colour: str, width: float, opacity: float) -> str:
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in _pixels(p_G, middle, left))
    style = f'stroke="{colour}" stroke-width="{width}" stroke-opacity="{opacity}"'
    return f'<polyline points="{points}" fill="none" {style}/>'


def main() -> None:
    """Run the demo and draw it."""
    session = Session()
    truth = simulate(load_scenario("three_sessions")).truth
    with tempfile.TemporaryDirectory() as folder:
        session.run("demo", map_folder=Path(folder) / "merged")
    after = session.vi_map
    before = session.maps.selected.past[0].vi_map
    p_true = truth.T_G_I[:, 4:]
    first = before.vertices.mission == 0
    T_before = align_yaw_position(p_true[first], before.T_G_I[first, 4:])
    T_after = align_yaw_position(p_true, after.T_G_I[:, 4:])
    panels = _panel(before, T_before, p_true, "as the odometry left them", 0.0)
    panels += _panel(after, T_after, p_true, "merged, closed and optimised", PANEL_PX)
    size = f'width="{2 * PANEL_PX}" height="{PANEL_PX}" viewBox="0 0 {2 * PANEL_PX} {PANEL_PX}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif">'
    paper = '<rect width="100%" height="100%" fill="white"/>'
    TARGET.parent.mkdir(exist_ok=True)
    TARGET.write_text("\n".join([head, paper, *panels, "</svg>"]) + "\n")


if __name__ == "__main__":
    main()
