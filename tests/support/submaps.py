"""A mission of several submaps, as robots send them."""

import dataclasses
from collections.abc import Sequence

from maplab_py.vimap import VIMap
from maplab_py.vimap.submaps import AppendReport, append_submap


def append_submaps(submaps: Sequence[VIMap]) -> tuple[VIMap, AppendReport]:
    """Join submaps in the order of the time of their first vertex."""
    joined, *others = sorted(submaps, key=lambda submap: int(submap.vertices.timestamp_ns.min()))
    total = AppendReport(submaps=1)
    for submap in others:
        joined, report = append_submap(joined, submap)
        total = _sum(total, report)
    return joined, total


def _sum(a: AppendReport, b: AppendReport) -> AppendReport:
    values = {}
    for field in dataclasses.fields(AppendReport):
        x, y = getattr(a, field.name), getattr(b, field.name)
        values[field.name] = max(x, y) if field.name.startswith("largest") else x + y
    return AppendReport(**values)
