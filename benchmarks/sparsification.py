"""Times of sparsification on corridors of two sizes, with what the simple choices reach.

python -m benchmarks.sparsification
"""

import resource
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.sparsification import selection, sparsify
from maplab_py.algorithms.sparsification.selection import CoverageProblem, solve_relaxed
from tests.algorithms.sparsification.instances import corridor
from tests.support.machine import slowness

Mask = NDArray[np.bool_]


def main() -> None:
    """Print times, gaps to the bound, and how many keyframes are not covered."""
    for landmarks, keyframes in ((16_000, 760), (60_000, 2000)):
        problem = corridor(landmarks, keyframes, landmarks // 10)
        print(f"{landmarks} landmarks, {keyframes} keyframes", flush=True)
        bound = float("nan")
        available = np.bincount(problem.keyframe, minlength=keyframes)
        for name, choose in choices(landmarks).items():
            factor = slowness()
            begin = time.process_time()
            chosen, own_bound = choose(problem)
            seconds = time.process_time() - begin
            factor = 0.5 * (factor + slowness())
            bound = own_bound if np.isfinite(own_bound) else bound
            counts = np.bincount(problem.keyframe[chosen[problem.landmark]], minlength=keyframes)
            below = np.mean(counts < np.minimum(available, 30))
            gap = 1.0 - problem.objective(chosen) / bound
            print(
                f"  {name:14s} {seconds:6.1f} s processor, machine {factor:.2f} times slower than "
                f"ordinary: {seconds / factor:5.1f} s; gap {gap:.1e}, {100 * below:.1f} % of "
                "keyframes below 30",
                flush=True,
            )
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1e-6
    print(f"memory at most {memory:.2f} GB")


def choices(landmarks: int) -> dict[str, Callable[[CoverageProblem], tuple[Mask, float]]]:
    """Return the ways to choose; each gives the choice and, if it knows one, a bound."""

    def relaxed(problem: CoverageProblem) -> tuple[Mask, float]:
        solution = solve_relaxed(problem)
        return solution.chosen, solution.bound

    def by_parts(problem: CoverageProblem) -> tuple[Mask, float]:
        return sparsify.solve_by_parts(problem, landmarks // 4)[0].chosen, float("nan")

    def plain(choose: Callable[[CoverageProblem], Mask]) -> Callable[..., tuple[Mask, float]]:
        return lambda problem: (choose(problem), float("nan"))

    return {
        "relaxed": relaxed,
        "by parts": by_parts,
        "greedy": plain(selection.choose_greedily),
        "most observed": plain(selection.choose_most_observed),
        "random": plain(lambda problem: selection.choose_random(problem, 0)),
    }


if __name__ == "__main__":
    main()
