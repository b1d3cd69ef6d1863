"""Living maps: recall, size and time over a year of sessions in a place that changes.

python -m benchmarks.living_maps [SEED ...] [--sessions=30] [--results=FILE]

Every session updates five maps: one that keeps everything, and four within the budget of session 3 (its
landmarks and vertices): by evidence, by observer counts, by these without the inertial measurements of old
sessions as evidence has it (`packed`), and by keeping the newest sessions. Observer counts alone, of
`landmark_sparsify` and `remove_covered_vertices`, have no more megabytes than evidence. The next session is
localised in each of them. A line of JSON is written per session and map.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.landmarks.evidence import read_evidence, with_evidence
from maplab_py.algorithms.landmarks.persistence import PersistenceOptions, existence
from maplab_py.algorithms.localization.database import database_of_map
from maplab_py.algorithms.localization.localization import align_robustly, localize_missions
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.algorithms.map_update.changes import MIN_EARLIER, missing_regions, seen_by
from maplab_py.algorithms.map_update.options import UpdateOptions
from maplab_py.algorithms.map_update.thinning import choose_vertices, size_mb, thin
from maplab_py.algorithms.map_update.update import gather, merge_session, prepare_session
from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.sparsification.sparsify import sparsify
from maplab_py.array_types import I64
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SessionSimulator
from maplab_py.simulation.world import World
from maplab_py.vimap import VIMap
from maplab_py.vimap.edits import remove_missions
from maplab_py.vimap.ids import IdIndex
from maplab_py.vimap.vertex_removal import remove_vertices

BUDGET_SESSIONS, REFURBISHED = 3, 20
NEAR_M = 0.5
QUERY_EVERY = 5
"""Every fifth image of a session is a query."""
BINS = 10
LEAST_SEEN, LEAST_HITS, ON_BOX_M = 3, 2, 1e-3
"""Landmarks of a piece of furniture that sessions saw, and that a region has, to count; and its border."""
_PERSISTENCE = PersistenceOptions()


@dataclasses.dataclass
class Truth:
    """True poses and points of the sessions so far, by id."""

    vertex_id: Any
    T_G_I: Any
    landmark_id: Any
    point: Any
    exists: Any  # (sessions, P)

    def extended(self, truth: Any) -> Truth:
        """Return the truth with one more session."""
        return Truth(
            np.concatenate([self.vertex_id, truth.vertex_id]),
            np.concatenate([self.T_G_I, truth.T_G_I]),
            np.concatenate([self.landmark_id, truth.landmark_id]),
            np.concatenate([self.point, truth.landmark_point]),
            self.exists,
        )


def recall(vi_map: VIMap, query: VIMap, truth: Truth) -> dict[str, float]:
    """Localise the vertices of a session in a map and compare with the truth."""
    database = database_of_map(vi_map)
    begin = time.process_time()
    query = remove_vertices(query, np.arange(len(query.vertices)) % QUERY_EVERY > 0)
    found = localize_missions(database, query, LocalizationOptions())
    seconds = time.process_time() - begin
    index = IdIndex(truth.vertex_id)
    observers = index.rows(database.observer_id)
    known = observers >= 0
    T_R_G = align_robustly(
        truth.T_G_I[observers[known], 4:], database.p_G_observer[known], level=True
    )
    true_p = truth.T_G_I[index.rows(query.vertices.id[found.vertex]), 4:]
    error = np.linalg.norm(se3.transform(T_R_G, found.T_G_I[:, 4:]) - true_p, axis=1)
    good = found.is_localized & (error < NEAR_M)
    return {
        "queries": len(error),
        "recall": float(good.mean()),
        "wrong": int(np.count_nonzero(found.is_localized & ~good)),
        "median_m": float(np.median(error[good])) if good.any() else float("nan"),
        "query_ms": 1e3 * seconds / max(len(error), 1),
    }


def calibration(vi_map: VIMap, truth: Truth, session: int) -> list[list[float]]:
    """Return number, mean probability and true share of landmarks by probability, in ten bins."""
    evidence = read_evidence(vi_map)
    row = IdIndex(truth.landmark_id).rows(vi_map.landmarks.id)
    used = (row >= 0) & (evidence["recent"]["time_s"][:, -1] > 0)
    probability = existence(evidence[used], _PERSISTENCE)
    exists = truth.exists[session][truth.point[row[used]]]
    bins = np.minimum((probability * BINS).astype(np.int64), BINS - 1)
    count = np.bincount(bins, minlength=BINS)
    sums = [np.bincount(bins, values, minlength=BINS) for values in (probability, exists)]
    return [[float(n), float(p), float(e)] for n, p, e in zip(count, *sums, strict=True)]


def objects(vi_map: VIMap, truth: Truth, world: World, numbers: I64, split: int) -> dict[str, int]:
    """Compare the changes that are reported at a refurbishment with those of the furniture and points.

    A region is right if half of its landmarks do not exist in the session of the image that is shown to miss
    them; `strict` counts those that exist in none of the sessions on that side. Furniture counts that has
    `LEAST_SEEN` mapped landmarks; `unmapped` is the number of the other pieces.

    Args:
        vi_map: Map of all its sessions.
        truth: Their truth.
        world: The world.
        numbers: Numbers (M,) of the sessions.
        split: The first session after it.
    """
    assert world.exists is not None
    assert world.has_box is not None
    point = truth.point[IdIndex(truth.landmark_id).rows(vi_map.landmarks.id)]
    good = vi_map.landmarks.quality == 2
    result = dict.fromkeys(("right", "strict", "wrong", "found", "all", "unmapped"), 0)
    session_of = numbers[vi_map.vertices.mission[vi_map.frames.vertex]]
    for by in (numbers >= split, numbers < split):
        is_later = bool(by[-1])
        least = 1 if is_later else MIN_EARLIER
        regions, _ = missing_regions(vi_map, by, least_sessions=least)
        gone = ~world.exists[numbers[by]][:, point].any(axis=0)
        for region in regions:
            exists = world.exists[session_of[region.missing_frame], point[region.landmarks]]
            result["right" if exists.mean() <= 0.5 else "wrong"] += 1
            result["strict"] += bool(gone[region.landmarks].mean() >= 0.5)
        seen = good & gone & seen_by(vi_map, ~by)
        before, after = world.has_box[split - 1], world.has_box[split]
        for low, high in world.boxes[before & ~after if is_later else after & ~before]:
            p = world.p_G[point]
            mine = seen & ((p > low - ON_BOX_M) & (p < high + ON_BOX_M)).all(axis=1)
            if np.count_nonzero(mine) < LEAST_SEEN:
                result["unmapped"] += 1
                continue
            hits = [np.count_nonzero(mine[region.landmarks]) for region in regions]
            result["all"] += 1
            result["found"] += int(max(hits, default=0) >= LEAST_HITS)
    return result


def mean_deviation(bins: list[list[float]]) -> float:
    """Return the mean deviation of a calibration curve, weighted by the number of landmarks."""
    table = np.array(bins)
    return float(np.abs(table[:, 1] - table[:, 2]).sum() / max(table[:, 0].sum(), 1.0))


def keep_newest(vi_map: VIMap, landmarks: int, vertices: int, _: float) -> VIMap:
    """Return the map with the newest missions that fit, and their most useful landmarks."""
    counts = np.diff(vi_map.vertex_start)
    order = np.argsort(-vi_map.vertices.timestamp_ns[vi_map.vertex_start[:-1]], kind="stable")
    dropped = np.zeros(len(counts), dtype=np.bool_)
    dropped[order[np.cumsum(counts[order]) > vertices]] = True
    return chosen_by_counts(remove_missions(vi_map, dropped), landmarks, vertices)


def by_counts(vi_map: VIMap, landmarks: int, vertices: int, megabytes: float) -> VIMap:
    """Return the map chosen by observer counts, of both budgets the same share that fits the megabytes."""
    share, result = 1.0, chosen_by_counts(vi_map, landmarks, vertices)
    while size_mb(result) > megabytes:
        share *= max(0.97 * megabytes / size_mb(result), 0.5)
        most = max(int(share * landmarks), 1), max(int(share * vertices), 1)
        result = chosen_by_counts(vi_map, *most)
    return result


def packed(vi_map: VIMap, landmarks: int, vertices: int, _: float) -> VIMap:
    """Return the map chosen by observer counts, old sessions without inertial measurements."""
    return by_evidence(with_evidence(vi_map, None), landmarks, vertices, np.inf)


def chosen_by_counts(vi_map: VIMap, landmarks: int, vertices: int) -> VIMap:
    """Return the map with landmarks chosen by observer counts, and vertices that cover them."""
    vi_map = with_evidence(vi_map, None)
    if len(vi_map.landmarks) > landmarks:
        vi_map, _, _ = sparsify(vi_map, landmarks, SparsificationOptions())
    if len(vi_map.vertices) > vertices:
        kept = choose_vertices(vi_map, vertices, UpdateOptions().observers_kept)
        emptied = np.bincount(vi_map.vertices.mission[kept], minlength=len(vi_map.missions)) == 0
        ids = vi_map.vertices.id[kept]
        vi_map = remove_missions(vi_map, emptied)
        removed = np.ones(len(vi_map.vertices), dtype=np.bool_)
        removed[vi_map.vertex_index.rows(ids)] = False
        vi_map = remove_vertices(vi_map, removed)
    return vi_map


def by_evidence(vi_map: VIMap, landmarks: int, vertices: int, _: float) -> VIMap:
    """Return the map within the budget by the evidence of its sessions."""
    is_new = np.zeros(len(vi_map.missions), dtype=np.bool_)
    is_new[-1] = True
    options = UpdateOptions(max_landmarks=landmarks, max_vertices=vertices)
    return thin(vi_map, is_new, options, _PERSISTENCE)[0]


METHODS: dict[str, Callable[[VIMap, int, int, float], VIMap]] = {
    "evidence": by_evidence,
    "everything": lambda vi_map, *_: vi_map,
    "counts": by_counts,
    "packed": packed,
    "newest": keep_newest,
}


def run(
    seed: int, sessions: int, methods: list[str], write: Callable[[dict[str, Any]], None]
) -> None:
    """Update the maps with session after session of one seed."""
    simulator = SessionSimulator(load_scenario("office_year").with_seed(seed))
    first = simulator.session(0)
    none = Truth(*(np.zeros((0, n), t) for n, t in ((2, "u8"), (7, "f8"), (2, "u8"))), None, None)
    none = dataclasses.replace(none, point=np.zeros(0, np.int64), exists=simulator.world.exists)
    truth = none.extended(first.truth)
    base = prepare_session(first.vi_map)
    base = base.replace(baseframes=base.baseframes.replace(is_known=np.ones(1, dtype=np.bool_)))
    maps, budget = dict.fromkeys(methods, base), (0, 0)
    megabytes = np.inf  # of the map by evidence, the first of the methods
    for number in range(1, sessions):
        simulated = simulator.session(number)
        truth = truth.extended(simulated.truth)
        session = prepare_session(simulated.vi_map)
        for name in methods:
            line = {"seed": seed, "session": number, "map": name}
            if number >= BUDGET_SESSIONS:
                line |= recall(maps[name], simulated.vi_map, truth)
            begin = time.process_time()
            try:
                whole, *_ = merge_session(maps[name], session)
                numbers = np.arange(len(whole.missions))  # where no mission was refused
            except EstimationError as error:
                write(line | {"refused": str(error)})
                continue
            if name in ("evidence", "everything"):
                whole, report = gather(whole, len(whole.missions) - 1)
                line |= {"false_match": report.false_match, "detection": report.detection}
                line["calibration"] = calibration(whole, truth, number)
            if number >= BUDGET_SESSIONS:
                whole = METHODS[name](whole, *budget, megabytes)
                megabytes = size_mb(whole) if name == "evidence" else megabytes
            if name == "everything" and number == sessions - 1 >= REFURBISHED:
                line["objects"] = objects(whole, truth, simulator.world, numbers, REFURBISHED)
            line["update_s"] = time.process_time() - begin
            maps[name] = whole
            write(line | {
                "mb": size_mb(whole), "landmarks": len(whole.landmarks),
                "vertices": len(whole.vertices), "missions": len(whole.missions),
            })  # fmt: skip
        if number == BUDGET_SESSIONS - 1:
            largest = maps[methods[0]]
            good = int(np.count_nonzero(largest.landmarks.quality == 2))
            budget = good, len(largest.vertices)


def main() -> None:
    """Run the seeds that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", nargs="*", type=int, default=[1])
    parser.add_argument("--sessions", type=int, default=30)
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--results", type=Path)
    arguments = parser.parse_args()

    def write(line: dict[str, Any]) -> None:
        text = json.dumps(line)
        print(text, flush=True)
        if arguments.results:
            with arguments.results.open("a") as file:
                file.write(text + "\n")

    for seed in arguments.seeds:
        run(seed, arguments.sessions, arguments.methods.split(","), write)


if __name__ == "__main__":
    main()
