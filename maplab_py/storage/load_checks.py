"""Consistency checks of a map while it is loaded."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.distinct import distinct
from maplab_py.errors import MapError
from maplab_py.report import counted
from maplab_py.storage import extension_fields
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.protobuf import map_files
from maplab_py.storage.protobuf.ids import ids_of, unknown_bytes
from maplab_py.storage.protobuf.tables_from_messages import Content
from maplab_py.vimap import IdIndex, VIMap, consistency, to_hex

_FIELDS = {
    map_files.FileKind.MISSIONS: ("missions", "mission_ids", "baseframes", "baseframe_ids"),
    map_files.FileKind.VERTICES: ("vertices", "vertex_ids"),
    map_files.FileKind.EDGES: ("edges", "edge_ids"),
    map_files.FileKind.LANDMARK_INDEX: ("landmark_index", "legacy_landmark_ids"),
}
ENTITIES = {
    "vertex": "vertices",
    "edge": "edges",
    "mission": "missions",
    "baseframe": "baseframes",
}
"""Entities with ids, by the name of their ids in the format."""
_NO_NUMBER = "non-finite"
_NAMED = 3
"""Ids that a note names."""


@dataclasses.dataclass(frozen=True)
class FileFacts:
    """Facts about a file for the check of all files."""

    kind: map_files.FileKind
    path: Path
    is_empty: bool
    has_roots: bool
    has_vertices: bool


def check_file(kind: map_files.FileKind, path: Path, message: pb.VIMap) -> FileFacts:
    """Check that a file holds the kind that it is listed with, with one id per entity.

    Raises:
        MapError: The check fails; names the file and the field.
    """
    held = {field.name for field, _ in message.ListFields()}
    foreign = sorted(held - set(_FIELDS[kind]))
    if foreign:
        raise MapError(
            f"{path}: is listed as {kind.name.lower()} (file_type {kind:d}) but holds "
            f"{', '.join(foreign)}"
        )
    for name, plural in ENTITIES.items():
        entities, there = len(getattr(message, plural)), len(getattr(message, f"{name}_ids"))
        if entities != there:
            raise MapError(f"{path}: holds {entities} {plural} but {there} {name}_ids")
    has_roots = any(any(mission.root_vertex_id.words) for mission in message.missions)
    return FileFacts(kind, path, not held, has_roots, bool(message.vertices))


def check_empty_files(files: Sequence[FileFacts]) -> None:
    """Check that a file is empty only as the single file of a kind that the map does not need.

    Raises:
        MapError: The check fails; names the file and the field.
    """
    kinds = [file.kind for file in files]
    needed = {
        map_files.FileKind.MISSIONS: any(file.has_vertices for file in files),
        map_files.FileKind.VERTICES: any(file.has_roots for file in files),
    }
    for file in files:
        if file.is_empty and (kinds.count(file.kind) > 1 or needed.get(file.kind, False)):
            raise MapError(
                f"{file.path}: is empty: it holds no {_FIELDS[file.kind][0]}; {map_files.COPY_AGAIN}"
            )


def edge_kinds(content: Content) -> list[str]:
    """Return the measurement kind of every edge, which is the name of its only field.

    Raises:
        MapError: An edge has none or several; names file and id.
    """
    kinds = []
    for row, edge in enumerate(content.edges):
        names = [field.name for field, _ in edge.ListFields()]
        if len(names) != 1:
            said = " and ".join(names) if names else "no known kind of measurement"
            raise MapError(f"{content.name('edges', row)}: holds {said} instead of one")
        kinds.append(names[0])
    return kinds


def check_listed_edges(
    content: Content, kinds: Sequence[str], vertex_index: IdIndex, *, repair: bool
) -> list[str]:
    """Compare the edges that vertices list with the edges that start and end there.

    Args:
        kinds: Kind of every edge.
        vertex_index: Rows of vertices in file order.
        repair: Use the edges instead of raising an error.

    Returns:
        Notes.

    Raises:
        MapError: A vertex lists an edge that is not in the map or not at this vertex.
    """
    edge_index = IdIndex(content.edge_ids)
    wrong = unlisted = 0
    for field, end in (("outgoing_edges", "from_vertex_id"), ("incoming_edges", "to_vertex_id")):
        owner, listed = content.listed_edges[field]
        edges = edge_index.rows(listed)
        ends = [getattr(getattr(e, k), end) for e, k in zip(content.edges, kinds, strict=True)]
        vertex = vertex_index.rows(ids_of(ends, f"{end} of an edge"))
        is_there = edges >= 0
        is_right = is_there & (np.append(vertex, -1)[edges] == owner)
        bad = np.flatnonzero(~is_right)
        if len(bad) and not repair:
            first = int(bad[0])
            what = "is not at this vertex" if is_there[first] else "is not in the map"
            raise MapError(
                f"{content.name('vertices', int(owner[first]))}: edge {to_hex(listed[first])} of "
                f"its {field} {what}; load with --repair to use the edges"
            )
        wrong += len(bad)
        unlisted += len(ends) - len(distinct(edges[is_right]))
    notes = []
    if wrong:
        notes.append(f"{wrong} listed ends of edges repaired")
    if unlisted:
        notes.append(f"{unlisted} ends of edges are not listed by their vertices; saving adds them")
    return notes


def check_records(content: Content, max_bytes: int) -> None:
    """Check that the loop-closure records of missions fit into memory.

    Raises:
        MapError: A record is too large; names file and mission. Damaged records are not reported here.
    """
    left = max_bytes // extension_fields.RECORD_SHARE
    for row, mission in enumerate(content.missions):
        record = extension_fields.read_extension(
            unknown_bytes(mission), extension_fields.LOOP_RECORD
        )
        if record is None:
            continue
        left -= extension_fields.packed_size(record, left)
        if left < 0:
            raise MapError(
                f"{content.name('missions', row)}: its record of loop closures unpacks to more "
                f"than {max_bytes / extension_fields.RECORD_SHARE / 1e6:g} MB (a quarter of "
                "--proto_max_size_megabytes; raise it if the record is really that large)"
            )


def absent_parts(folder: Path, vi_map: VIMap) -> list[str]:
    """Return a note for each optional part that the folder lacks."""
    notes = [
        f"{name} is not there" for name in (map_files.METADATA,) if not (folder / name).is_file()
    ]
    if len(vi_map.resources) and not (folder / map_files.RESOURCE_INFO).is_file():
        notes.append(
            f"{map_files.RESOURCE_INFO} is not there: resources are looked up in the map's folder"
        )
    without = vi_map.sensors.without_extrinsics()
    if without:
        notes.append(
            f"{map_files.SENSORS}: {counted(len(without), 'sensor')} without extrinsics, taken to be at the "
            f"base sensor: {_some(without)}"
        )
    return notes


def consistency_notes(vi_map: VIMap) -> list[str]:
    """Return the violations of `check_map_consistency` that do not prevent loading.

    Raises:
        MapError: The map violates a rule that every command requires; names the rule and an id.
    """
    refused, tolerated = consistency.check_loaded(vi_map)
    if refused:
        raise MapError(_refusal(refused[0], "load"))
    return [_said(violation) for violation in tolerated]


def check_loadable(vi_map: VIMap, folder: Path) -> None:
    """Check that a map could be loaded after it was saved.

    Raises:
        MapError: It could not; names the rule and an id.
    """
    refused = consistency.check_saved(vi_map)
    if refused:
        reason = _refusal(refused[0], "save")
        raise MapError(f"{folder}: not saved, as it could not be loaded: {reason}")


def _refusal(violation: consistency.Violation, verb: str) -> str:
    """Return what a map violates, and what to do about it; the verb is that of the command."""
    remedy = "check_map_consistency lists such rules"
    if _NO_NUMBER in violation.rule:
        remedy = f"{verb} with --repair to drop what is no number"
    return f"{_said(violation)}; {remedy}"


def _said(violation: consistency.Violation) -> str:
    where = f": {_some(violation.where)}" if violation.where else ""
    return f"{violation.rule} ({violation.count}){where}"


def _some(names: Sequence[Any]) -> str:
    more = ", ..." if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more
