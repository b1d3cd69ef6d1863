"""Tango: the second half of a walk is localised in a map of the first half, and leaves it for a while.

There is no ground truth: the optimum of the whole walk with its closures is taken for it, and its first half
is the map. A map made of the first half alone has another scale (4 %), which no localisation can know. The
query has the recorded tracks and starts at the optimised state, in a mission frame that is moved
and turned at random.
"""

import dataclasses
from pathlib import Path

import numpy as np

from benchmarks.online_localization.euroc import scrambled_start
from benchmarks.online_localization.modes import MODES, Comparison, PoseErrors, compare, pose_errors
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.summary.workflow import WorkflowOptions, make_localization_map
from maplab_py.array_types import F64, I64
from maplab_py.frontend.localization.map_source import of_map
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.geometry import se3
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap
from maplab_py.vimap.excerpts import cut_by_time

_AWAY_S = 3.0
"""Without an answer for so long, the walk is away from the map."""


@dataclasses.dataclass(frozen=True)
class Absence:
    """A time without an answer of the map."""

    begin_s: float  # after the first frame
    duration_s: float
    drift_m: float  # error of VIL at the first answer after it, as predicted
    error_m: float  # 0.5 s after that answer
    step_m: float  # largest difference of the steps of T_M_I in that time from those without a map


@dataclasses.dataclass(frozen=True)
class Exploration:
    """Errors by mode, and what happens when the walk leaves the map."""

    frames: int
    answered_share: float  # of the queries
    errors: dict[str, PoseErrors]
    largest_step_m: float  # difference of the steps of T_M_I from those without a map
    median_step_m: float
    absences: list[Absence]


def optimum(raw: VIMap) -> VIMap:
    """Return the walk after optimisation, relaxation and loop closure, with all its vertices."""
    options = WorkflowOptions(keyframing=KeyframingOptions(every_nth_vertex=1))
    return make_localization_map(raw, options)[0]


def measure(folder: Path, options: OnlineLocalizationOptions) -> Exploration:
    """Localise the second half of the walk in the map of the first half."""
    raw, _ = load_map(folder)
    whole = optimum(raw)
    times_ns, truth = whole.vertices.timestamp_ns, whole.T_G_I
    half_s = 0.5e-9 * float(np.ptp(times_ns))
    vi_map, after = cut_by_time(whole, half_s)
    searched = of_map(vi_map, "first half", with_covariances=options.rule.estimates_landmarks)
    query = MapRecording(cut_by_time(raw, half_s)[1], 0)
    result = compare(query, searched, options, make_starter=scrambled_start(after, 1))
    errors = {
        mode: pose_errors(result.results[mode], times_ns, truth, result.frames) for mode in MODES
    }
    times, steps = _steps(result)
    return Exploration(
        frames=result.frames,
        answered_share=len(result.answered_ns) / max(result.counts.queries, 1),
        errors=errors,
        largest_step_m=float(steps.max()),
        median_step_m=float(np.median(steps)),
        absences=_absences(result, times_ns, truth, times, steps),
    )


def _steps(result: Comparison) -> tuple[I64, F64]:
    """Return times (N,) and by how much steps of T_M_I differ from those without a map (N,) [m]."""
    tight, plain = result.results["vil"], result.results["odo"]
    times_ns, a, b = np.intersect1d(tight.times_ns, plain.times_ns, return_indices=True)
    moves = [
        se3.compose(se3.inverse(T_M_I[:-1]), T_M_I[1:])[:, 4:]
        for T_M_I in (tight.T_M_I[a], plain.T_M_I[b])
    ]
    return times_ns[1:], np.linalg.norm(moves[0] - moves[1], axis=1)


def _absences(
    result: Comparison, times_ns: I64, truth: F64, step_times_ns: I64, steps: F64
) -> list[Absence]:
    vil, answered_ns = result.results["vil"], result.answered_ns
    row = np.searchsorted(times_ns, vil.times_ns)
    error_m = np.linalg.norm(truth[row, 4:] - vil.T_G_I[:, 4:], axis=1)
    absences = []
    for before, after in zip(answered_ns[:-1].tolist(), answered_ns[1:].tolist(), strict=True):
        if after - before < 1e9 * _AWAY_S:
            continue
        settled = after + 500_000_000
        near = (step_times_ns >= after) & (step_times_ns <= settled)
        absences.append(
            Absence(
                begin_s=1e-9 * (before - int(vil.times_ns[0])),
                duration_s=1e-9 * (after - before),
                drift_m=float(error_m[np.searchsorted(vil.times_ns, after)]),
                error_m=float(error_m[min(np.searchsorted(vil.times_ns, settled), len(row) - 1)]),
                step_m=float(steps[near].max(initial=0.0)),
            )
        )
    return absences
