"""Rebuild Fig. 5.6 of the thesis: how small a map may become before localisation suffers.

python docs/scripts/map_maintenance.py [--work=FOLDER]

Four simulated sessions make a map; a fifth is localised in summary maps of it, keyframed or not,
with 0 to 98 % of the landmarks pruned by different methods. Writes docs/map_maintenance.json,
the table in docs/map_maintenance.md and docs/images/map_maintenance.svg. Takes about half an hour
of one processor; what the work folder holds already is not made again.
"""

from __future__ import annotations

import argparse
import dataclasses
import gzip
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.keyframing.heuristic import keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.algorithms.localization.database import database_of_summary
from maplab_py.algorithms.localization.localization import Reference, describe, localize_missions
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.algorithms.loop_closure.features import map_features
from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.sparsification.sparsify import sparsify
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.console.session import Session
from maplab_py.geometry.alignment import umeyama
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import Truth
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.summary_map import SummaryMap, write_summary_map
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.edits import remove_vertices
from maplab_py.vimap.ids import IdIndex
from maplab_py.vision.projection import DescriptorProjection

DOCS = Path(__file__).resolve().parents[1]
FRACTIONS = (0.0, 0.5, 0.75, 0.9, 0.95, 0.98)
METHODS = ("ilp", "most_observed", "random")
QUERY_EVERY = 20
MIN_ANGLE_DEG = 2.0
COLOURS = {"ilp": "#0b6fb8", "most_observed": "#c8501e", "random": "#888888"}
NAMES = {"ilp": "integer programme", "most_observed": "most observed", "random": "random"}


@dataclasses.dataclass(frozen=True)
class Point:
    """One map variant."""

    keyframed: bool
    pruned: float
    method: str
    landmarks: int
    observations: int
    maplab_megabytes: float | None  # maplab's fields only, as exact as it writes them
    megabytes: float  # our file
    recall: float
    wrong: int
    median_error_m: float


def sessions(work: Path) -> None:
    """Simulate all sessions, unless they are there."""
    if (work / "truth.npz").is_file():
        return
    data = simulate(load_scenario(str(Path(__file__).with_suffix(".yaml"))))
    for number, vi_map in enumerate(data.maps):
        place = "query" if number == len(data.maps) - 1 else f"sessions/session_{number + 1}"
        save_map(vi_map, work / place, overwrite=True)
    data.truth.save(work / "truth.npz")


def full_map(work: Path) -> VIMap:
    """Return the map of the first four sessions, merged by the usual commands."""
    if not (work / "full").is_dir():
        session = Session()
        session.run("load_merge_all_maps", maps_folder=work / "sessions", target_map_key="full")
        for command in ("elq", "optvi", "sbk", "aam", "relax", "lc", "rtl"):
            session.run(command)
        session.run("save", map_folder=work / "full")
    # distant landmarks help as well: accept smaller angles than mapping does
    options = LandmarkQualityOptions(min_observation_angle_deg=MIN_ANGLE_DEG)
    return evaluate_quality(load_map(work / "full")[0], options)[0]


def maplab_megabytes(summary: SummaryMap) -> float:
    """Return the size of the file that maplab would write."""
    message = pb.LocalizationSummaryMap()
    message.p_G_landmark.extend(summary.p_G.ravel().tolist())
    inner = message.uncompressed_map
    inner.descriptors.rows, inner.descriptors.cols = summary.descriptors.T.shape
    inner.descriptors.data.extend(summary.descriptors.ravel().tolist())
    inner.p_G_observer.extend(summary.p_G_observer.ravel().tolist())
    inner.observer_indices.extend(summary.observer.tolist())
    inner.observation_to_landmark_index.extend(summary.landmark.tolist())
    return len(gzip.compress(message.SerializeToString(), 6)) * 1e-6


class Experiment:
    """The query, the truth, and what all variants share."""

    def __init__(self, query: VIMap, truth: Truth, projection: DescriptorProjection) -> None:
        gone = np.ones(len(query.vertices), dtype=np.bool_)
        gone[::QUERY_EVERY] = False
        self._query = remove_vertices(query, gone)
        self._truth, self._index = truth, IdIndex(truth.vertex_id)
        self._projection = projection

    def measure(self, vi_map: VIMap, *, keyframed: bool, pruned: float, method: str) -> Point:
        """Localise the query in the summary map of one variant."""
        plain = None
        if method == METHODS[0]:
            exact = SummaryMapOptions(descriptor_step=0.0, covariances=False)
            plain = make_summary_map(vi_map, exact, projection=self._projection)
        summary = make_summary_map(vi_map, SummaryMapOptions(), projection=self._projection)
        with tempfile.TemporaryDirectory() as folder:
            size = write_summary_map(summary, Path(folder)).stat().st_size * 1e-6
        database = database_of_summary(summary)
        found = localize_missions(database, self._query, LocalizationOptions())
        row = self._index.rows(self._query.vertices.id[found.vertex])
        reference = Reference("truth", self._truth.T_G_I[row], row >= 0)
        observers = self._index.rows(database.observer_id)
        T_R_G, _ = umeyama(self._truth.T_G_I[observers, 4:], database.p_G_observer)
        report = describe(database, found, reference=reference, T_R_G=T_R_G)
        error = report.position_error_m
        return Point(
            keyframed=keyframed,
            pruned=pruned,
            method=method,
            landmarks=report.map_landmarks,
            observations=report.map_observations,
            maplab_megabytes=None if plain is None else maplab_megabytes(plain),
            megabytes=size,
            recall=report.success_share,
            wrong=report.wrong,
            median_error_m=error.median if error is not None else float("nan"),
        )


def run(work: Path) -> list[Point]:
    """Measure all variants."""
    sessions(work)
    full = full_map(work)
    _, projection = map_features(full, np.arange(len(full.missions)))
    truth = Truth.load(work / "truth.npz")
    experiment = Experiment(load_map(work / "query")[0], truth, projection)
    thin, _ = keyframe(full, KeyframingOptions())
    known = work / "points.json"
    stored = json.loads(known.read_text()) if known.is_file() else []
    points = [Point(**values) for values in stored]
    for keyframed, pruned, method in variants():
        if any((p.keyframed, p.pruned, p.method) == (keyframed, pruned, method) for p in points):
            continue
        vi_map = thin if keyframed else full
        good = int(np.count_nonzero(vi_map.landmarks.quality == LandmarkQuality.GOOD))
        if pruned:
            options = SparsificationOptions(method=method)
            vi_map, _, _ = sparsify(vi_map, round((1.0 - pruned) * good), options)
        points.append(experiment.measure(vi_map, keyframed=keyframed, pruned=pruned, method=method))
        known.write_text(json.dumps([dataclasses.asdict(point) for point in points]))
        print(points[-1], flush=True)  # noqa: T201
    return points


def variants() -> list[tuple[bool, float, str]]:
    """Return all variants, those first that tell most."""
    whole = [(keyframed, 0.0, METHODS[0]) for keyframed in (True, False)]
    pruned = [(kf, f, m) for kf in (True, False) for m in METHODS for f in FRACTIONS[1:]]
    return whole + pruned


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
        cells.append(_cell([f"{p.maplab_megabytes:.3f}" if p else None for p in pair]))
        cells.append(_cell([f"{p.megabytes:.3f}" if p else None for p in pair]))
        for method in METHODS:
            found = [_find(points, keyframed, pruned, method) for keyframed in (False, True)]
            cells.append(_cell([f"{100 * p.recall:.1f} %" if p else None for p in found]))
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _cell(values: list[str | None]) -> str:
    return f"{values[0] or '-'} ({values[1] or '-'})"


def _find(points: list[Point], keyframed: bool, pruned: float, method: str) -> Point | None:
    """Return a variant; without pruning all methods are the same."""
    wanted = (keyframed, pruned, method if pruned else METHODS[0])
    found = [p for p in points if (p.keyframed, p.pruned, p.method) == wanted]
    return found[0] if found else None


def plot(points: list[Point]) -> str:
    """Return the figure as SVG: recall over the pruned part; dashed = keyframed."""
    left, top, width, height = 60.0, 20.0, 560.0, 300.0

    def at(pruned: float, recall: float) -> str:
        # the axis is the logarithm of what is kept, so that 98 % is not squeezed into a corner
        x = left + width * np.log(1.0 - pruned) / np.log(1.0 - FRACTIONS[-1])
        return f"{x:.1f},{top + height * (1.0 - recall):.1f}"

    size = 'width="660" height="400" viewBox="0 0 660 400"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="12">',
        '<rect width="100%" height="100%" fill="white"/>',
    ]
    for step in range(0, 101, 20):
        y = top + height * (1.0 - step / 100.0)
        lines.append(f'<path d="M{left} {y} h{width}" stroke="#dddddd"/>')
        lines.append(f'<text x="{left - 8}" y="{y + 4}" text-anchor="end">{step} %</text>')
    for pruned in FRACTIONS:
        x = at(pruned, 0.0).split(",")[0]
        y = top + height + 18
        lines.append(f'<text x="{x}" y="{y}" text-anchor="middle">{100 * pruned:.0f} %</text>')
    middle = left + width / 2
    lines.append(f'<text x="{middle}" y="358" text-anchor="middle">landmarks pruned</text>')
    for number, method in enumerate(METHODS):
        for keyframed in (False, True):
            found = [_find(points, keyframed, pruned, method) for pruned in FRACTIONS]
            path = " ".join(at(p.pruned, p.recall) for p in found if p is not None)
            dash = ' stroke-dasharray="6 4"' if keyframed else ""
            style = f'stroke="{COLOURS[method]}" stroke-width="2" fill="none"{dash}'
            lines.append(f'<polyline points="{path}" {style}/>')
        x = left + 190 * number
        lines.append(f'<path d="M{x} 380 h24" stroke="{COLOURS[method]}" stroke-width="2"/>')
        lines.append(f'<text x="{x + 30}" y="384">{NAMES[method]}</text>')
    lines.append(f'<text x="{left + width}" y="384" text-anchor="end">dashed: keyframed</text>')
    return "\n".join([*lines, "</svg>", ""])


def write(points: list[Point]) -> None:
    """Write data, table and figure into the documentation."""
    data: list[dict[str, Any]] = [dataclasses.asdict(point) for point in points]
    text = ",\n".join(json.dumps(point) for point in data)
    (DOCS / "map_maintenance.json").write_text(f"[\n{text}\n]\n")
    (DOCS / "images" / "map_maintenance.svg").write_text(plot(points))
    page = DOCS / "map_maintenance.md"
    before, _, rest = page.read_text().partition("<!-- table -->\n")
    _, _, after = rest.partition("<!-- end of table -->\n")
    lines = "\n".join(table(points))
    page.write_text(f"{before}<!-- table -->\n{lines}\n<!-- end of table -->\n{after}")


def main() -> None:
    """Measure what is missing, or only write what was measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, default=None)
    parser.add_argument("--write_only", action="store_true")
    arguments = parser.parse_args()
    if arguments.write_only:
        stored = json.loads((arguments.work / "points.json").read_text())
        write([Point(**values) for values in stored])
    elif arguments.work is not None:
        write(run(arguments.work))
    else:
        with tempfile.TemporaryDirectory() as folder:
            write(run(Path(folder)))


if __name__ == "__main__":
    main()
