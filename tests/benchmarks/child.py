"""One solver on one problem in a process of its own: `python -m tests.benchmarks.child ...`.

Prints one line of JSON: effort of the fastest of several runs, memory of the first, cost.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
from collections.abc import Callable
from typing import Any

from tests.benchmarks.problems import SIZES, make_inertial, make_visual
from tests.benchmarks.solution import Effort, Solution, StoppingRule

Solve = Callable[[Any, StoppingRule], tuple[Solution, Effort]]


def solver_of(kind: str, name: str) -> Solve:
    """Return the function that solves problems of a kind."""
    if name == "maplab":
        from tests.benchmarks import maplab_solver

        return maplab_solver.solve_visual if kind == "visual" else maplab_solver.solve_inertial
    if (kind, name) == ("visual", "ceres"):
        from tests.benchmarks.ceres_solver import solve_visual

        return solve_visual
    if (kind, name) == ("inertial", "gtsam"):
        from tests.benchmarks.gtsam_solver import solve_inertial

        return solve_inertial
    raise ValueError(f"no solver '{name}' for {kind} problems")


def main() -> None:
    """Solve and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=("visual", "inertial"))
    parser.add_argument("solver", choices=("maplab", "ceres", "gtsam"))
    parser.add_argument("size", choices=tuple(SIZES))
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    make = make_visual if arguments.kind == "visual" else make_inertial
    solve, rule = solver_of(arguments.kind, arguments.solver), StoppingRule()
    solve(make("tiny"), rule)  # loads libraries and compiled kernels
    problem = make(arguments.size)
    runs = [solve(problem, rule) for _ in range(arguments.repeats)]
    solution, first = runs[0]
    fastest = min((spent for _, spent in runs), key=lambda spent: spent.user_s + spent.system_s)
    visual = problem if arguments.kind == "visual" else problem.visual
    result = {
        **dataclasses.asdict(fastest),
        "wall_s": min(spent.wall_s for _, spent in runs),
        "peak_growth_mb": first.peak_growth_mb,
        "iterations": solution.iterations,
        "cost": solution.cost,
        "keyframes": len(visual.T_G_I),
        "observations": len(visual.keyframe),
        "cpus": len(os.sched_getaffinity(0)),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
