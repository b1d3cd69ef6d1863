"""Times of sparsification on corridors of two sizes, with what the simple choices reach.

python -m tests.benchmarks.sparsification
"""

from __future__ import annotations

import resource
import time

import numpy as np

from maplab_py.algorithms.sparsification import greedy
from maplab_py.algorithms.sparsification.integer_programme import solve_relaxed
from maplab_py.algorithms.sparsification.partition import solve_by_parts
from tests.algorithms.sparsification.instances import corridor


def main() -> None:
    """Print times, gaps to the bound, and how many keyframes are not covered."""
    for landmarks, keyframes in ((16_000, 760), (60_000, 2000)):
        for weighted in (False, True):
            problem = corridor(landmarks, keyframes, landmarks // 10, weighted=weighted)
            print(f"{landmarks} landmarks, {keyframes} keyframes, weighted: {weighted}")
            choices = {
                "relaxed": lambda p: solve_relaxed(p).chosen,
                "by parts": lambda p: solve_by_parts(p, landmarks // 4)[0].chosen,  # noqa: B023
                "greedy": greedy.choose_greedily,
                "most observed": greedy.choose_most_observed,
                "random": lambda p: greedy.choose_random(p, 0),
            }
            bound = solve_relaxed(problem).bound
            for name, choose in choices.items():
                begin, processor = time.perf_counter(), time.process_time()
                chosen = choose(problem)
                seconds, used = time.perf_counter() - begin, time.process_time() - processor
                counts = np.bincount(
                    problem.keyframe[chosen[problem.landmark]], minlength=keyframes
                )
                available = np.bincount(problem.keyframe, minlength=keyframes)
                below = np.mean(counts < np.minimum(available, 30))
                gap = 1.0 - problem.objective(chosen) / bound
                print(
                    f"  {name:14s} {seconds:6.1f} s ({used:5.1f} s processor), gap {gap:.1e}, "
                    f"{100 * below:.1f} % of keyframes below 30"
                )
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1e-6
    print(f"memory at most {memory:.2f} GB")


if __name__ == "__main__":
    main()
