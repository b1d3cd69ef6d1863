"""Many sessions round one loop of 200 m: what a factor takes, in time and in memory.

`python -m benchmarks.loop_sessions SESSIONS KEYFRAMES [--iterations N] [--forcing X]`
`[--max_memory_gb GB]`

Keyframes are 0.75 m apart and look outwards at a wall; every landmark has been merged over all
sessions and laps. With inertial samples, so that each keyframe has 15 states.
"""

import argparse

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import problems
from benchmarks.maplab_solver import inertial_parts
from benchmarks.solution import effort
from maplab_py.estimation.linear.supernodal_solver import SupernodalCholesky
from maplab_py.estimation.problem import gauge, iterative
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.problem.solver import SolverOptions, optimize_states
from maplab_py.memory import memory_limited
from maplab_py.progress import SILENT

LOOP_M, SPACING_M = 200.0, 0.75
_LANDMARKS_PER_M = 90.0
_NEAREST_M, _FARTHEST_M = 2.0, 4.0
_REACH_M = 1.5  # along the wall: keyframes up to 3 m apart see a landmark in common
_DETECTED = 0.6
_IMAGE_PX = np.array([752.0, 480.0])


def make_loop(sessions: int, keyframes: int, seed: int = 0) -> problems.InertialProblem:
    """Make the problem of some sessions with so many keyframes each; the same every time."""
    rng = np.random.default_rng(seed)
    along_m = np.arange(keyframes) * SPACING_M
    begin_m = rng.uniform(0.0, LOOP_M, sessions)
    lane_m = rng.uniform(-0.4, 0.4, sessions)
    T_G_I = np.concatenate(
        [_walk(along_m + begin, lane) for begin, lane in zip(begin_m, lane_m, strict=True)]
    )
    place_m = np.concatenate([along_m + begin for begin in begin_m]) % LOOP_M
    p_G, keyframe, landmark = _sightings(T_G_I, place_m, rng)
    visual = problems.disturbed_problem(T_G_I, p_G, keyframe, landmark, rng)
    return problems.with_inertial_samples(visual, keyframes, rng)


def _walk(along_m: problems.F64, lane_m: float) -> problems.F64:
    """Return poses (V, 7) at distances along the loop: z looks outwards, y down."""
    angle = 2.0 * np.pi * along_m / LOOP_M
    radius = LOOP_M / (2.0 * np.pi) + lane_m + 0.1 * np.sin(0.4 * along_m)
    height = 0.1 * np.sin(0.7 * along_m)
    outwards = np.column_stack([np.cos(angle), np.sin(angle), 0.05 * np.sin(0.3 * along_m)])
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    x = np.cross(outwards, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R_G_C = np.stack([x, np.cross(outwards, x), outwards], axis=2)
    p = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    return np.concatenate([Rotation.from_matrix(R_G_C).as_quat(), p], axis=1)


def _sightings(
    T_G_I: problems.F64, place_m: problems.F64, rng: np.random.Generator
) -> tuple[problems.F64, problems.I64, problems.I64]:
    """Return landmarks (L, 3), and keyframe and landmark of each observation, by landmark."""
    count = int(_LANDMARKS_PER_M * LOOP_M)
    at_m = np.sort(rng.uniform(0.0, LOOP_M, count))
    angle, radius = 2.0 * np.pi * at_m / LOOP_M, LOOP_M / (2.0 * np.pi)
    radius = radius + rng.uniform(_NEAREST_M, _FARTHEST_M, count)
    height = rng.uniform(-1.5, 1.5, count)
    p_G = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    keyframes, landmarks = [], []
    for row in range(len(T_G_I)):
        off_m = np.abs((at_m - place_m[row] + 0.5 * LOOP_M) % LOOP_M - 0.5 * LOOP_M)
        near = np.flatnonzero((off_m < _REACH_M) & (rng.random(count) < _DETECTED))
        uv, depth = problems.project(np.broadcast_to(T_G_I[row], (len(near), 7)), p_G[near])
        seen = near[(depth > 0.5) & (uv > 0.0).all(axis=1) & (uv < _IMAGE_PX).all(axis=1)]
        keyframes.append(np.full(len(seen), row))
        landmarks.append(seen)
    keyframe, landmark = np.concatenate(keyframes), np.concatenate(landmarks)
    often = np.bincount(landmark, minlength=count) >= 2
    row_of = np.cumsum(often) - 1
    kept = often[landmark]
    keyframe, landmark = keyframe[kept], row_of[landmark[kept]]
    order = np.lexsort((keyframe, landmark))
    return p_G[often], keyframe[order], landmark[order]


def main() -> None:
    """Make, solve and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sessions", type=int)
    parser.add_argument("keyframes", type=int)
    parser.add_argument("--iterations", type=int, default=3)
    parser.add_argument("--forcing", type=float, default=0.0, help="of pcg; 0 = direct")
    parser.add_argument("--max_memory_gb", type=float, default=0.0, help="for a factor; 0 = all")
    arguments = parser.parse_args()
    _solve(make_loop(2, 20), arguments.forcing, 1)  # loads compiled kernels
    problem = make_loop(arguments.sessions, arguments.keyframes)
    print(f"{len(problem.visual.T_G_I)} keyframes, {len(problem.visual.keyframe)} observations")
    with memory_limited(arguments.max_memory_gb):
        print(_solve(problem, arguments.forcing, arguments.iterations))


def _solve(made: problems.InertialProblem, forcing: float, iterations: int) -> str:
    """Optimise and say what it took."""
    states, visual, factors = inertial_parts(made)
    with effort() as spent:
        if forcing:
            problem: Problem = iterative.IterativeProblem(
                states, visual, factors, None, iterative.IterativeOptions(forcing=forcing)
            )
        else:
            problem = Problem(states, visual, factors)
        gauge.fix_pose(problem, np.arange(problems.NUM_KNOWN_POSES))
        options = SolverOptions(num_iterations=iterations, function_tolerance=0.0)
        _, summary = optimize_states(problem, states, options, SILENT)
    factor = ""
    if isinstance(problem.solver, SupernodalCholesky):
        size = problem.solver.statistics
        factor = f"factor {8e-9 * size.nonzeros:.3f} GB, {size.flops:.3g} flop; "
    return (
        f"{factor}{problem.linear_solver}: {summary.iterations} iterations, "
        f"{spent.user_s + spent.system_s:.1f} s processor, {spent.wall_s:.1f} s; memory grew by "
        f"{spent.peak_growth_mb:.0f} MB; cost {sum(summary.final_costs.values())!r}; "
        f"{problem.linear_iterations} iterations of conjugate gradients"
    )


if __name__ == "__main__":
    main()
