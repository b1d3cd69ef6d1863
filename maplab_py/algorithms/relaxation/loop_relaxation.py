"""Find loop closures and relax the map over them."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.record_updates import with_closures
from maplab_py.algorithms.loop_closure.reports import LoopClosureReport
from maplab_py.algorithms.loop_closure.workflow import search_loops
from maplab_py.algorithms.relaxation.options import RelaxationOptions, RelaxationReport
from maplab_py.algorithms.relaxation.relaxation import relax_graph
from maplab_py.array_types import I64
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap
from maplab_py.vimap.descriptors import type_name, types_of
from maplab_py.vimap.ids import IdIndex


def relax_over_loops(
    vi_map: VIMap,
    options: RelaxationOptions,
    loop_options: LoopClosureOptions,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, LoopClosureReport, RelaxationReport]:
    """Relax a map over the closures that are found in it and the edges that it has.

    The closures go into the map's record with the weight that was left to each; they do not become
    edges. A closure that is an edge of the map already counts once.

    Raises:
        EstimationError: Nothing to recognise places by, or the pose graph has no usable solution.
    """
    wanted = loop_options.type_number
    if wanted not in types_of(vi_map.frames) and len(vi_map.loop_closure_edges):
        relaxed = relax_graph(vi_map, options, missions=missions, progress=progress)
        name = type_name(wanted)
        note = f"the map has no {name} descriptors: only its own loop closure edges count"
        return relaxed.vi_map, LoopClosureReport(notes=(note,)), relaxed.report
    search, search_report = search_loops(vi_map, loop_options, missions=missions, progress=progress)
    new = IdIndex(vi_map.loop_closure_edges.id).rows(search.edges.id) < 0
    relaxed = relax_graph(
        vi_map,
        options,
        loop_closures=search.edges.take(new),
        missions=missions,
        progress=progress,
    )
    used = IdIndex(relaxed.closures.id).rows(search.closures.id)
    result = with_closures(
        relaxed.vi_map,
        search.closures,
        "relax",
        used=(used >= 0) & search.closures.accepted,
        weight=np.append(relaxed.weight, 1.0)[used],
    )
    return result, search_report, relaxed.report
