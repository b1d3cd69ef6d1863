"""Draw docs/images/server.svg: the map of a server while four robots feed it, from above.

python docs/scripts/draw_server.py
"""

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.geometry import se3
from maplab_py.geometry.alignment import align_yaw_position
from maplab_py.server.merging import Merger
from maplab_py.server.options import IncrementalOptions, MergingOptions
from maplab_py.server.submap_sources import timed_submaps
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import Truth
from maplab_py.storage.mission_names import named
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import IdIndex

F64 = NDArray[np.float64]

TARGET = Path(__file__).resolve().parents[1] / "images" / "server.svg"
COLOURS = ("#0b6fb8", "#c8501e", "#2b8a4b", "#8a4fa3")
SUBMAP_S = 15.0
PANEL_PX, PANEL_HEIGHT_PX, HEAD_PX, MARGIN_PX = 300, 150, 46, 12


def main() -> None:
    """Merge the submaps of four robots; draw the map at a third, at two thirds and at the end."""
    scenario = load_scenario("four_sessions")
    measurement = dataclasses.replace(scenario.measurement, frame_rate_hz=2.0, max_keypoints=120)
    data = simulate(dataclasses.replace(scenario, measurement=measurement))
    robots = [f"robot_{number + 1}" for number in range(len(data.maps))]
    submaps = timed_submaps(dict(zip(robots, data.maps, strict=True)), SUBMAP_S)
    merger = Merger(MergingOptions(), IncrementalOptions())
    shown = [round(len(submaps) * part / 3) for part in (1, 2, 3)]
    panels: list[list[str]] = []
    for number, submap in enumerate(submaps, start=1):
        merger.add(_prepared(named(submap.vi_map, [submap.robot])))
        if number == len(submaps):
            merger.optimize_jointly()
        if number in shown and merger.vi_map is not None:
            title = f"{number} of {len(submaps)} submaps"
            left = len(panels) * (PANEL_PX + MARGIN_PX)
            panels.append(_panel(merger.vi_map, data.truth, robots, title, left))
    width = len(panels) * (PANEL_PX + MARGIN_PX) - MARGIN_PX
    height = PANEL_HEIGHT_PX + HEAD_PX
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        'font-family="sans-serif" font-size="13">',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        *[line for panel in panels for line in panel],
        "</svg>",
    ]
    TARGET.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _prepared(submap: VIMap) -> VIMap:
    judged, _ = evaluate_quality(submap, LandmarkQualityOptions())
    return optimize(judged, VIOptimizationOptions(hide_iterations_console_output=True))[0]


def _panel(vi_map: VIMap, truth: Truth, robots: list[str], title: str, left: int) -> list[str]:
    """Return the drawing of anchored missions on their true paths."""
    rows = IdIndex(truth.vertex_id).rows(vi_map.vertices.id)
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    is_shown = known[vi_map.vertices.mission]
    p_true = truth.T_G_I[:, 4:]
    T_true_G = align_yaw_position(p_true[rows[is_shown]], vi_map.T_G_I[is_shown, 4:])
    p_G = se3.transform(T_true_G, vi_map.T_G_I[:, 4:])
    good = (vi_map.landmarks.quality == 2) & is_shown[vi_map.landmarks.vertex]
    landmarks = se3.transform(T_true_G, vi_map.p_G[good])
    low, high = p_true[:, :2].min(axis=0) - 3.0, p_true[:, :2].max(axis=0) + 3.0
    scale = PANEL_PX / float((high - low).max())
    middle = 0.5 * (low + high)

    def pixels(points: F64) -> F64:
        centre = np.array([left + PANEL_PX / 2, HEAD_PX + PANEL_HEIGHT_PX / 2])
        return np.asarray(centre + (points[:, :2] - middle) * np.array([1.0, -1.0]) * scale)

    lines = [f'<text x="{left + PANEL_PX / 2}" y="18" text-anchor="middle">{title}</text>']
    lines += [
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="0.7" fill="#c4c4c4"/>'
        for x, y in pixels(landmarks)
        if left < x < left + PANEL_PX and HEAD_PX < y < HEAD_PX + PANEL_HEIGHT_PX
    ]
    for number, (robot, colour) in enumerate(zip(robots, COLOURS, strict=True)):
        missions = [row for row, name in enumerate(vi_map.missions.name) if name == robot]
        own = np.isin(vi_map.vertices.mission, missions)
        x = left + (number + 0.5) * PANEL_PX / len(robots)
        state = "" if known[missions].all() else " (waits)"
        lines.append(
            f'<text x="{x:.0f}" y="36" text-anchor="middle" fill="{colour}" font-size="11">'
            f"{robot.replace('_', ' ')}{state}</text>"
        )
        if own.any() and known[missions].all():
            points = " ".join(f"{a:.1f},{b:.1f}" for a, b in pixels(p_G[own]))
            lines.append(
                f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.8"/>'
            )
    return lines


if __name__ == "__main__":
    main()
