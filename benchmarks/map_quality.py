"""Landmarks after README's workflow on simulated sessions, and what limits of optvi cost.

python -m benchmarks.map_quality workflow [SEED ...] [--keyframed] [--scenario NAME]
python -m benchmarks.map_quality thinning [SEED ...] [--keyframed] [--scenario NAME]
"""

import argparse
import dataclasses
import time
from collections.abc import Iterator

import numpy as np

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.geometry import alignment, se3
from maplab_py.simulation import evaluation, scenario_file
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import Truth
from maplab_py.vimap import IdIndex, LandmarkQuality, VIMap
from tests.algorithms.loop_closure.against_truth import joined

NEAR_M = 0.05
STEPS = ("optvi", "set_mission_baseframe_to_known", "anchor_all_missions", "relax", "lc")
LIMITS = ((0, 0), (40, 0), (20, 0), (10, 0), (5, 0), (0, 100), (0, 50), (0, 20), (10, 50))


@dataclasses.dataclass(frozen=True)
class WorkflowFigures:
    """The map at the end of the workflow, against the truth."""

    seed: int
    vertices: int
    landmarks: int
    observed_twice: int
    good: int
    good_of_near: float  # good ones among landmarks within NEAR_M of the truth
    near_of_good: float  # within NEAR_M of the truth among good ones
    median_m: float  # error of landmarks
    median_good_m: float
    merges: int
    precision: float
    recall: float
    ate_m: float


@dataclasses.dataclass(frozen=True)
class ThinningFigures:
    """One optvi of the merged map with limits."""

    per_landmark: int
    covisible: int
    observations: int
    over_limit: int
    not_covisible: int
    processor_s: float
    iterations: int
    solver: str
    ate_m: float
    median_m: float  # error of landmarks


def sessions(scenario: str, seed: int) -> tuple[VIMap, Truth]:
    """Return the sessions of a scenario in one map, and the truth."""
    data = simulate(scenario_file.load_scenario(scenario).with_seed(seed))
    return joined(data), data.truth


def merged(vi_map: VIMap, *, keyframed: bool) -> VIMap:
    """Run README's workflow up to `lc`."""
    session = Session(load_registry())
    session.maps.add("map", vi_map)
    for command in (("kfh",) if keyframed else ()) + STEPS:
        session.run(command)
    return session.maps.selected.vi_map


def workflow_figures(vi_map: VIMap, truth: Truth, seed: int) -> WorkflowFigures:
    """Compare a map with the truth."""
    errors = evaluation.evaluate_map(vi_map, truth)
    shown = evaluation.shown_points(evaluation.sightings(vi_map, truth), len(vi_map.landmarks))
    row = IdIndex(truth.vertex_id).rows(vi_map.vertices.id)
    aligned, _ = alignment.umeyama(truth.T_G_I[row, 4:], vi_map.T_G_I[:, 4:])
    known = np.flatnonzero(shown >= 0)
    offset = se3.transform(aligned, vi_map.p_G[known]) - truth.point_G[shown[known]]
    error = np.linalg.norm(offset, axis=1)
    good = vi_map.landmarks.quality[known] == LandmarkQuality.GOOD
    possible = errors.merges + errors.missed_merges
    return WorkflowFigures(
        seed=seed,
        vertices=len(vi_map.vertices),
        landmarks=len(vi_map.landmarks),
        observed_twice=int(np.count_nonzero(np.diff(vi_map.observation_start) >= 2)),
        good=int(np.count_nonzero(vi_map.landmarks.quality == LandmarkQuality.GOOD)),
        good_of_near=float(np.mean(good[error < NEAR_M])),
        near_of_good=float(np.mean(error[good] < NEAR_M)),
        median_m=float(np.median(error)),
        median_good_m=float(np.median(error[good])),
        merges=errors.merges,
        precision=1.0 - errors.false_merges / max(errors.merges, 1),
        recall=errors.merges / max(possible, 1),
        ate_m=errors.ate_m,
    )


def thinning_figures(vi_map: VIMap, truth: Truth) -> Iterator[ThinningFigures]:
    """Optimise a merged map with different limits; the first run compiles and is not reported."""
    optimize(vi_map, VIOptimizationOptions(num_iterations=1, max_observations_per_landmark=5))
    for per_landmark, covisible in LIMITS:
        options = VIOptimizationOptions(
            max_observations_per_landmark=per_landmark, max_covisible_frames=covisible
        )
        begin = time.process_time()
        result, report = optimize(vi_map, options)
        seconds = time.process_time() - begin
        errors = evaluation.evaluate_map(result, truth)
        yield ThinningFigures(
            per_landmark, covisible, report.observations, report.observations_over_limit,
            report.observations_not_covisible, seconds, report.iterations, report.linear_solver,
            errors.ate_m, errors.landmark_median_m or 0.0,
        )  # fmt: skip


def main() -> None:
    """Measure what is asked for and print one line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["workflow", "thinning"])
    parser.add_argument("seeds", nargs="*", type=int, default=[1])
    parser.add_argument("--keyframed", action="store_true")
    parser.add_argument("--scenario", default="one_room_many_sessions")
    arguments = parser.parse_args()
    for seed in arguments.seeds:
        vi_map, truth = sessions(arguments.scenario, seed)
        vi_map = merged(vi_map, keyframed=arguments.keyframed)
        if arguments.what == "thinning":
            for figures in thinning_figures(vi_map, truth):
                _print(figures)
        else:
            vi_map, _ = optimize(vi_map, VIOptimizationOptions())
            _print(workflow_figures(vi_map, truth, seed))


def _print(figures: WorkflowFigures | ThinningFigures) -> None:
    values = dataclasses.asdict(figures).items()
    short = (f"{k}={v:.5g}" if isinstance(v, float) else f"{k}={v}" for k, v in values)
    print("  ".join(short), flush=True)


if __name__ == "__main__":
    main()
