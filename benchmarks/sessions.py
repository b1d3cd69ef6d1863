"""Bundle adjustment of many sessions in one place, by images alone.

Who sees what is that of the simulated scenario `one_room_many_sessions`, every landmark merged as the
world's points are. Pixels, camera and disturbed initial values are those of the other problems.
"""

import dataclasses
import multiprocessing

import numpy as np

from benchmarks.problems import I64, VisualProblem, disturbed_problem
from maplab_py.geometry import se3
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import Truth

SECONDS = {"tiny": 2.0, "small": 12.0, "room": 45.0}
"""Duration of each of the four sessions."""
_CLOSEST_M = 0.5


def make_sessions(name: str, seed: int = 0) -> VisualProblem:
    """Make the problem of a size; the same every time.

    The simulation runs in a process of its own, so that a solver gets none of its freed memory.
    """
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_make, (name, seed))


def _make(name: str, seed: int) -> VisualProblem:
    scenario = load_scenario("one_room_many_sessions")
    share = SECONDS[name] / scenario.sessions[0].duration_s
    sessions = tuple(
        dataclasses.replace(session, duration_s=SECONDS[name], turns=share * session.turns)
        for session in scenario.sessions
    )
    truth = simulate(dataclasses.replace(scenario, sessions=sessions)).truth
    T_G_C = se3.compose(truth.T_G_I, truth.T_I_C[truth.vertex_mission, 0])
    keyframe, point = _sightings(truth, T_G_C)
    points, landmark = np.unique(point, return_inverse=True)
    return disturbed_problem(
        T_G_C, truth.point_G[points], keyframe, landmark, np.random.default_rng(seed)
    )


def _sightings(truth: Truth, T_G_C: np.ndarray) -> tuple[I64, I64]:
    """Return keyframe and world point of every observation, sorted by point, then keyframe."""
    keyframe = np.repeat(np.arange(len(truth.frame_keypoints)), truth.frame_keypoints)
    is_seen = (truth.keypoint_landmark >= 0) & (truth.keypoint_point >= 0)
    pairs = np.stack([truth.keypoint_point[is_seen], keyframe[is_seen]], axis=1)
    point, keyframe = np.unique(pairs, axis=0).T
    p_C = se3.transform(se3.inverse(T_G_C[keyframe]), truth.point_G[point])
    often = np.bincount(point) >= 2
    kept = (p_C[:, 2] > _CLOSEST_M) & often[point]
    return keyframe[kept], point[kept]
