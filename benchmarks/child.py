"""One solver on one problem in a process of its own: `python -m benchmarks.child ...`.

Prints one line of JSON: effort of the fastest of several runs, memory of the first, cost.
"""

import argparse
import dataclasses
import json
import os
from collections.abc import Callable
from typing import Any

from benchmarks.problems import SIZES, make_inertial, make_visual
from benchmarks.sessions import SECONDS, make_sessions
from benchmarks.solution import SAME_STEPS, Effort, Solution, StoppingRule

_MAKE: dict[str, Callable[[str], Any]] = {
    "visual": make_visual,
    "inertial": make_inertial,
    "sessions": make_sessions,
}
Solve = Callable[[Any, StoppingRule], tuple[Solution, Effort]]


def solver_of(kind: str, name: str) -> Solve:
    """Return the function that solves problems of a kind."""
    if name == "maplab":
        from benchmarks import maplab_solver

        return maplab_solver.solve_inertial if kind == "inertial" else maplab_solver.solve_visual
    if kind != "inertial" and name == "ceres":
        from benchmarks.ceres_solver import solve_visual

        return solve_visual
    if (kind, name) == ("inertial", "gtsam"):
        from benchmarks.gtsam_solver import solve_inertial

        return solve_inertial
    raise ValueError(f"no solver '{name}' for {kind} problems")


def main() -> None:
    """Solve and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=tuple(_MAKE))
    parser.add_argument("solver", choices=("maplab", "ceres", "gtsam"))
    parser.add_argument("size", choices=tuple({**SIZES, **SECONDS}))
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    make = _MAKE[arguments.kind]
    solve = solver_of(arguments.kind, arguments.solver)
    rule = SAME_STEPS if arguments.kind == "sessions" else StoppingRule()
    solve(make("tiny"), rule)  # loads libraries and compiled kernels
    problem = make(arguments.size)
    runs = [solve(problem, rule) for _ in range(arguments.repeats)]
    solution, first = runs[0]
    fastest = min((spent for _, spent in runs), key=lambda spent: spent.user_s + spent.system_s)
    visual = problem.visual if arguments.kind == "inertial" else problem
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
