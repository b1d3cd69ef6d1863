"""Create a localisation map from raw sessions: maplab's workflow for any number of missions."""

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.anchoring.options import AnchoringOptions
from maplab_py.algorithms.keyframing.heuristic import keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.algorithms.landmarks.tracks import init_tracks
from maplab_py.algorithms.landmarks.triangulation import retriangulate
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import close_loops, search_loops
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax
from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.sparsification.sparsify import sparsify
from maplab_py.algorithms.summary.options import WorkflowReport, WorkflowStep
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.errors import EstimationError
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.vimap import VIMap

_FIRST_ITERATIONS, _LAST_ITERATIONS = 10, 25
"""maplab's limits; the relaxation step has separate limits."""
_MIN_OBSERVERS = 2
"""Minimum number of observers after keyframing, which removes most observations."""

Step = Callable[[VIMap], tuple[VIMap, Report]]


@dataclasses.dataclass(frozen=True)
class WorkflowOptions:
    """Options of the steps."""

    keyframing: KeyframingOptions = KeyframingOptions()
    loop_closure: LoopClosureOptions = LoopClosureOptions()
    sparsification: SparsificationOptions = SparsificationOptions()
    landmarks_to_keep: int = 0  # 0 = all good ones


def make_localization_map(
    vi_map: VIMap, options: WorkflowOptions, *, progress: Progress = SILENT
) -> tuple[VIMap, WorkflowReport]:
    """Triangulate, keyframe, optimise, anchor, relax, close loops, optimise again, sparsify.

    Missions of unknown base frame are anchored; if none is known, the first one defines G.

    Raises:
        EstimationError: Nothing can be optimised, or a mission cannot be anchored.
    """
    quality = LandmarkQualityOptions(min_observers=_MIN_OBSERVERS)
    several = len(vi_map.missions) > 1
    steps: list[tuple[str, Step]] = [
        ("init_track_landmarks", lambda m: init_tracks(m, LandmarkQualityOptions())),
        ("retriangulate_landmarks", lambda m: retriangulate(m, LandmarkQualityOptions())),
        ("keyframe_heuristic", lambda m: keyframe(m, options.keyframing)),
        ("evaluate_landmark_quality", lambda m: evaluate_quality(m, quality)),
        ("optimize_visual_inertial", lambda m: _optimize(m, _FIRST_ITERATIONS, progress)),
    ]
    if several:
        steps.append(
            ("anchor_all_missions", lambda m: _anchored(m, options.loop_closure, progress))
        )
    steps += [
        ("relax", lambda m: _relax(m, options.loop_closure, progress)),
        (
            "loopclosure_all_missions",
            lambda m: close_loops(m, options.loop_closure, progress=progress),
        ),
        ("optimize_visual_inertial", lambda m: _optimize(m, _LAST_ITERATIONS, progress)),
        ("evaluate_landmark_quality", lambda m: evaluate_quality(m, quality)),
    ]
    if options.landmarks_to_keep:
        steps.append(("landmark_sparsify", lambda m: _sparsify(m, options, progress)))
    lines = []
    for number, (name, step) in enumerate(steps):
        progress.step(number, len(steps), name)
        begin = time.perf_counter()
        vi_map, report = step(vi_map)
        seconds = time.perf_counter() - begin
        counts = len(vi_map.vertices), len(vi_map.landmarks)
        lines.append(WorkflowStep(name, *counts, seconds, report.failure))
    good = int(np.count_nonzero(vi_map.landmarks.quality == 2))
    report = WorkflowReport(tuple(lines), len(vi_map.missions), len(vi_map.vertices), good)
    return vi_map, report


def _optimize(vi_map: VIMap, iterations: int, progress: Progress) -> tuple[VIMap, Report]:
    options = VIOptimizationOptions(num_iterations=iterations)
    return optimize(vi_map, options, progress=progress)


def _anchored(vi_map: VIMap, loops: LoopClosureOptions, progress: Progress) -> tuple[VIMap, Report]:
    frames = vi_map.baseframes
    if not frames.is_known[vi_map.missions.baseframe].any():
        first = vi_map.missions.baseframe[0]
        vi_map = vi_map.replace(baseframes=frames.put(first, is_known=True))
    result, report = anchor_missions(vi_map, AnchoringOptions(), loops, progress=progress)
    if report.not_anchored:
        raise EstimationError(f"{report.failure}; remove what does not belong to this map")
    return result, report


def _relax(vi_map: VIMap, loops: LoopClosureOptions, progress: Progress) -> tuple[VIMap, Report]:
    search, search_report = search_loops(vi_map, loops, progress=progress)
    if len(search.edges) == 0:
        return vi_map, search_report
    return relax(vi_map, RelaxationOptions(), loop_closures=search.edges, progress=progress)


def _sparsify(vi_map: VIMap, options: WorkflowOptions, progress: Progress) -> tuple[VIMap, Report]:
    keep, how = options.landmarks_to_keep, options.sparsification
    result, report, _ = sparsify(vi_map, keep, how, progress=progress)
    return result, report
