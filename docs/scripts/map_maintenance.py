"""Rebuild Fig. 5.6 of Schneider 2019: how small a map may become before localisation suffers.

python docs/scripts/map_maintenance.py [--work=FOLDER] [--optimised]

Four simulated sessions make a map; a fifth is localised in summary maps of it, keyframed or not,
with 0 to 98 % of the landmarks pruned by different methods. Writes docs/map_maintenance.json,
the table in docs/map_maintenance.md and docs/images/map_maintenance.svg. Takes about half an hour
of one processor; what the work folder holds already is not made again.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import gzip
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from map_maintenance_page import METHODS, Point, findings, plot, table
from numpy.typing import NDArray

from maplab_py.algorithms.keyframing.heuristic import keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.algorithms.landmarks.triangulation import retriangulate
from maplab_py.algorithms.localization.database import database_of_summary
from maplab_py.algorithms.localization.localization import Reference, describe, localize_missions
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.algorithms.loop_closure.features import map_features
from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.sparsification.selection import CoverageProblem
from maplab_py.algorithms.sparsification.sparsify import choose, coverage_problem
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map, rounded
from maplab_py.console.session.session import Session
from maplab_py.geometry.alignment import umeyama
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import Truth, true_map
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.summary_map import SummaryMap, summary_map_bytes
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.edits import merge_landmarks, remove_vertices
from maplab_py.vimap.ids import IdIndex
from maplab_py.vimap.merge import merge_maps
from maplab_py.vision.projection import DescriptorProjection

DOCS = Path(__file__).resolve().parents[1]
QUERY_EVERY = 10
COMMANDS = ("elq", "optvi", "sbk", "aam", "relax", "lc", "rtl")
"""That make one map of the sessions."""
UNITED_SHARE = 0.6
"""Of the tracks, that are united with others of the same point."""
MIN_ANGLE_DEG = 2.0


def sessions(work: Path) -> None:
    """Simulate all sessions, unless they are there."""
    if (work / "truth.npz").is_file():
        return
    data = simulate(load_scenario(str(Path(__file__).with_suffix(".yaml"))))
    for number, vi_map in enumerate(data.maps):
        place = "query" if number == len(data.maps) - 1 else f"sessions/session_{number + 1}"
        save_map(vi_map, work / place, overwrite=True)
    data.truth.save(work / "truth.npz")


def full_map(work: Path, truth: Truth, *, optimised: bool) -> VIMap:
    """Return the map of the first four sessions.

    Args:
        work: Where the sessions are.
        truth: The truth about them.
        optimised: Build it by the usual commands. Otherwise it gets the true poses, and tracks of
            the same point are united by the truth, as many as `lc` unites; landmarks are
            triangulated from the noisy keypoints.
    """
    # distant landmarks help as well: accept smaller angles than mapping does
    options = LandmarkQualityOptions(min_observation_angle_deg=MIN_ANGLE_DEG)
    if optimised:
        return evaluate_quality(optimised_map(work), options)[0]
    parts = [true_map(load_map(f)[0], truth) for f in sorted((work / "sessions").iterdir())]
    vi_map = functools.reduce(lambda a, b: merge_maps(a, b)[0], parts)
    point = truth.landmark_point[IdIndex(truth.landmark_id).rows(vi_map.landmarks.id)]
    united = np.random.default_rng(0).uniform(size=len(point)) < UNITED_SHARE
    rows = np.flatnonzero(united & (point >= 0))
    points, first = np.unique(point[rows], return_index=True)
    into = rows[first[np.searchsorted(points, point[rows])]]
    vi_map = merge_landmarks(vi_map, rows[rows != into], into[rows != into])
    return retriangulate(vi_map, options)[0]


def optimised_map(work: Path) -> VIMap:
    """Return the map that the console makes of the sessions, continued where an earlier run ended."""
    session = Session()
    done = [n for n in range(len(COMMANDS)) if (work / f"after_{n}_{COMMANDS[n]}").is_dir()]
    first = done[-1] + 1 if done else 0
    if done:
        place = work / f"after_{done[-1]}_{COMMANDS[done[-1]]}"
        session.run("load", map_folder=place, map_key="full")
    else:
        session.run("load_merge_all_maps", maps_folder=work / "sessions", target_map_key="full")
    for number in range(first, len(COMMANDS)):
        begin, wall = time.process_time(), time.perf_counter()
        report = session.run(COMMANDS[number])
        used, waited = time.process_time() - begin, time.perf_counter() - wall
        print(f"{COMMANDS[number]}: {used:.0f} s processor, {waited:.0f} s wall", flush=True)  # noqa: T201
        print(report, flush=True)  # noqa: T201
        session.run("save", map_folder=work / f"after_{number}_{COMMANDS[number]}")
    return session.vi_map


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

    def measure(
        self,
        summary: SummaryMap,
        exact: SummaryMap,
        *,
        keyframed: bool,
        pruned: float,
        method: str,
    ) -> Point:
        """Localise the query in the summary map of one variant, as written and not rounded."""
        plain = size = None
        if method == METHODS[0]:
            plain = maplab_megabytes(exact)
            size = len(summary_map_bytes(summary)) * 1e-6
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
            maplab_megabytes=plain,
            megabytes=size,
            queries=report.queries_with_reference,
            recall=report.success_share,
            wrong=report.wrong,
            median_error_m=error.median if error is not None else float("nan"),
        )


def restricted(summary: SummaryMap, chosen: NDArray[np.bool_]) -> SummaryMap:
    """Return a summary map of some of the landmarks (L,): what the sparsified map would give."""
    kept = chosen[summary.landmark]
    observers, observer = np.unique(summary.observer[kept], return_inverse=True)
    return dataclasses.replace(
        summary,
        p_G=summary.p_G[chosen],
        landmark_id=None,
        p_G_observer=summary.p_G_observer[observers],
        observer_id=summary.observer_id[observers],
        descriptors=summary.descriptors[kept],
        landmark=(np.cumsum(chosen) - 1)[summary.landmark[kept]].astype(np.uint32),
        observer=observer.reshape(-1).astype(np.uint32),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Variant:
    """A map, keyframed or not, with what all of its variants share."""

    vi_map: VIMap
    good: NDArray[np.int64]  # landmark rows
    summary: SummaryMap  # of all good landmarks
    exact: SummaryMap  # the same, not rounded
    problem: CoverageProblem  # of choosing among the good ones

    @classmethod
    def of(cls, vi_map: VIMap, projection: DescriptorProjection) -> Variant:
        """Summarise a map."""
        good = np.flatnonzero(vi_map.landmarks.quality == LandmarkQuality.GOOD)
        plain = SummaryMapOptions(descriptor_step=0.0, position_step_m=0.0, landmark_ids=True)
        exact = make_summary_map(vi_map, plain, projection=projection)
        problem, _ = coverage_problem(vi_map, good, len(good), SparsificationOptions())
        return cls(vi_map, good, rounded(exact, SummaryMapOptions()), exact, problem)

    def pruned(self, share: float, method: str) -> tuple[SummaryMap, SummaryMap]:
        """Return the summary maps, as written and not rounded, of what a method keeps."""
        chosen = self.good
        if share > 0.0:
            options = SparsificationOptions(method=method)
            keep = round((1.0 - share) * len(self.good))
            problem = dataclasses.replace(self.problem, keep=keep)
            chosen = self.good[choose(problem, options)[0].chosen]
        kept = IdIndex(self.vi_map.landmarks.id[chosen]).rows(self.summary.landmark_id) >= 0
        return restricted(self.summary, kept), restricted(self.exact, kept)


def run(work: Path, *, optimised: bool) -> list[Point]:
    """Measure all variants."""
    sessions(work)
    truth = Truth.load(work / "truth.npz")
    full = full_map(work, truth, optimised=optimised)
    _, projection = map_features(full, np.arange(len(full.missions)))
    experiment = Experiment(load_map(work / "query")[0], truth, projection)
    known = work / "points.json"
    stored = json.loads(known.read_text()) if known.is_file() else []
    points = [Point(**values) for values in stored]
    for keyframed in (True, False):
        missing = [
            (pruned, method)
            for pruned, method in variants()
            if not any(
                (p.keyframed, p.pruned, p.method) == (keyframed, pruned, method) for p in points
            )
        ]
        if not missing:
            continue
        vi_map = keyframe(full, KeyframingOptions())[0] if keyframed else full
        variant = Variant.of(vi_map, projection)
        for pruned, method in missing:
            maps = variant.pruned(pruned, method)
            points.append(
                experiment.measure(*maps, keyframed=keyframed, pruned=pruned, method=method)
            )
            known.write_text(json.dumps([dataclasses.asdict(point) for point in points]))
            print(points[-1], flush=True)  # noqa: T201
    return points


def variants() -> list[tuple[float, str]]:
    """Return all variants, those first that tell most."""
    pruned = (0.9, 0.95, 0.98, 0.5, 0.75)
    return [(0.0, METHODS[0]), *((f, m) for f in pruned for m in METHODS)]


def write(points: list[Point]) -> None:
    """Write data, table and figure into the documentation."""
    data: list[dict[str, Any]] = [dataclasses.asdict(point) for point in points]
    text = ",\n".join(json.dumps(point) for point in data)
    (DOCS / "map_maintenance.json").write_text(f"[\n{text}\n]\n")
    (DOCS / "images" / "map_maintenance.svg").write_text(plot(points))
    page = DOCS / "map_maintenance.md"
    text = page.read_text()
    for name, lines in (("table", table(points)), ("findings", findings(points))):
        before, _, rest = text.partition(f"<!-- {name} -->\n")
        _, _, after = rest.partition(f"<!-- end of {name} -->\n")
        inner = "\n".join(lines)
        text = f"{before}<!-- {name} -->\n{inner}\n<!-- end of {name} -->\n{after}"
    page.write_text(text)


def main() -> None:
    """Measure what is missing, or only write what was measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, default=None)
    parser.add_argument("--write_only", action="store_true")
    parser.add_argument(
        "--optimised", action="store_true", help="optimise the map, which takes long"
    )
    arguments = parser.parse_args()
    if arguments.write_only:
        stored = json.loads((arguments.work / "points.json").read_text())
        write([Point(**values) for values in stored])
    elif arguments.work is not None:
        write(run(arguments.work, optimised=arguments.optimised))
    else:
        with tempfile.TemporaryDirectory() as folder:
            write(run(Path(folder), optimised=arguments.optimised))


if __name__ == "__main__":
    main()
