"""Recorded loop closures, accepted and refused."""

import numpy as np

from maplab_py.algorithms.loop_closure.closure_record import ClosureRecord, read_record
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.listing import near_miss_order
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.array_types import I64
from maplab_py.errors import MapError
from maplab_py.viewer import colours
from maplab_py.viewer.drawing import Drawing, make_segments, omission_notes
from maplab_py.viewer.scene import WHOLE_MAP, Entity, Layer, LegendEntry

ACCEPTED, REFUSED = "accepted_closures", "refused_closures"
_MAX_SHOWN = 2000
"""Accepted closures that are shown at first; software draws more wide lines slowly."""
_REFUSED_WIDTH_PX = 1.0
_REFUSED_COLOUR = colours.from_hex("#a9adb6")[0]


def recorded_closures(drawing: Drawing) -> tuple[list[Layer], list[str]]:
    """Return a layer of accepted closures, one of refused ones, and what could not be read.

    The accepted ones are coloured by what relaxation has left of their weight.
    """
    try:
        record = read_record(drawing.vi_map).closures
    except MapError as error:
        return [], [str(error)]
    if not len(record):
        return [], []
    is_accepted = record.verdict == VERDICTS.index(Verdict.ACCEPTED)
    legend = LegendEntry.ramp("weight", colours.TRUST, "0", "1")
    colour = colours.ramp(record.weight, colours.TRUST)
    ends = [drawing.p_vertices[rows] for rows in closure_ends(drawing, record)]

    def layer(name: str, title: str, chosen: np.ndarray, *legends: LegendEntry) -> Layer:
        rows = np.flatnonzero(chosen)
        part = make_segments(ends[0][rows], ends[1][rows], colour[rows], rows, 1.5)
        return Layer(
            name, title, {WHOLE_MAP: part}, len(rows), Entity.CLOSURE,
            legend=legends, is_visible=len(rows) <= _MAX_SHOWN,
        )  # fmt: skip

    refused = np.flatnonzero(~is_accepted)
    chosen, notes = _chosen_refused(drawing, record, refused)
    counts = np.bincount(record.verdict[refused], minlength=len(VERDICTS))
    reasons = tuple(VERDICTS[code].value for code in np.flatnonzero(counts))
    part = make_segments(
        ends[0][chosen], ends[1][chosen], _REFUSED_COLOUR, chosen, _REFUSED_WIDTH_PX
    )
    return [
        layer(ACCEPTED, "Accepted closures", is_accepted, legend),
        Layer(
            REFUSED, "Refused closures", {WHOLE_MAP: part}, len(refused), Entity.CLOSURE,
            is_visible=False, notes=notes, choices=reasons,
        ),
    ], []  # fmt: skip


def _chosen_refused(
    drawing: Drawing, record: ClosureRecord, refused: I64
) -> tuple[I64, tuple[str, ...]]:
    """Return which of the refused closures (rows) are drawn, and why not all."""
    limit, reason = drawing.options.max_refused_closures, drawing.options.refused_closures_reason
    codes = [code for code, verdict in enumerate(VERDICTS) if reason.lower() in verdict.value]
    wanted = refused[np.isin(record.verdict[refused], codes)]
    chosen = wanted
    if len(wanted) > limit:
        order = near_miss_order(record)[wanted]
        chosen = np.sort(wanted[np.argsort(order, kind="stable")[:limit]])
    losses = (
        (len(refused) - len(wanted), "for another reason"),
        (len(wanted) - len(chosen), "by --vis_max_refused_closures"),
    )
    return chosen, omission_notes("Refused closures", len(chosen), *losses)


def closure_ends(
    drawing: Drawing, record: ClosureRecord
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.int64]], ...]:
    """Return the rows (N,) of the query's and of the place's vertex of each closure."""
    rows = drawing.vi_map.vertex_index.rows
    return rows(record.query).astype(np.int64), rows(record.place).astype(np.int64)
