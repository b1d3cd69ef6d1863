"""The files of a map one after another, each as tables or messages, and joined to one content."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import I64, U64
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.load_checks import ENTITIES, FileFacts, check_file
from maplab_py.storage.protobuf import scan, tables_from_messages, vertex_parts
from maplab_py.storage.protobuf.ids import ids_of, ids_of_parts
from maplab_py.storage.protobuf.map_files import FileKind, parse_message
from maplab_py.vimap.table import starts_of_counts

_NO_IDS = np.zeros((0, 2), dtype=np.uint64)


class FileParts:
    """Content of the files of a map, as far as it has been read."""

    def __init__(self) -> None:
        self.facts: list[FileFacts] = []
        self.vertices: list[vertex_parts.VertexPart] = []
        self.unpacked_bytes = 0
        self._entities: dict[str, list[Any]] = {
            name: [] for name in ("edges", "missions", "baseframes")
        }
        self._ids: dict[str, list[U64]] = {}
        self._file_of: dict[str, list[I64]] = {}
        self._index_path: Path | None = None

    def read(
        self, kind: FileKind, path: Path, data: bytes | bytearray, budget: scan.MemoryBudget
    ) -> None:
        """Parse the bytes of a file; of vertices and landmarks only tables are kept.

        Raises:
            MapError: The file is damaged, holds another kind, or takes more memory than is left.
        """
        self.unpacked_bytes += len(data)
        if kind is FileKind.LANDMARK_INDEX and self._read_large_index(path, data):
            return
        message = pb.VIMap()
        parse_message(path, data, message, budget)
        self.facts.append(check_file(kind, path, message))
        place = len(self.facts) - 1
        for name in ENTITIES:
            ids = ids_of(getattr(message, f"{name}_ids"), f"{path}: {name}_ids")
            self._ids.setdefault(f"{name}_ids", []).append(ids)
            self._file_of.setdefault(name, []).append(np.full(len(ids), place))
        for name, known in self._entities.items():
            known.extend(getattr(message, name))
        if message.landmark_index and self._index_path is None:
            self._index_path = path
        entries = message.landmark_index
        for name, ids in (
            ("legacy_landmark_ids", ids_of(message.legacy_landmark_ids, "legacy landmark ids")),
            ("index_vertex_ids", ids_of((e.vertex_id for e in entries), "landmark_index: vertex_id")),
            ("index_landmark_ids", ids_of((e.landmark_id for e in entries), "landmark_index: landmark_id")),
        ):  # fmt: skip
            self._ids.setdefault(name, []).append(ids)
        if message.vertices:
            part = vertex_parts.read_part(path, message, budget.max_bytes)
            self.vertices.append(part)
            budget.give_back(part.nbytes())
        elif len(entries):
            budget.give_back(sum(int(ids[-1].nbytes) for ids in self._ids.values()))

    @property
    def has_messages(self) -> bool:
        """Whether entities are kept as messages: edges, missions, base frames."""
        return any(self._entities.values())

    def add(self, other: FileParts) -> None:
        """Add what other files hold, as if they had been read after those of this object."""
        first = len(self.facts)
        self.facts += other.facts
        self.vertices += other.vertices
        self.unpacked_bytes += other.unpacked_bytes
        for name, entities in other._entities.items():
            self._entities[name] += entities
        for name, ids in other._ids.items():
            self._ids.setdefault(name, []).extend(ids)
        for name, places in other._file_of.items():
            self._file_of.setdefault(name, []).extend(place + first for place in places)
        self._index_path = self._index_path or other._index_path

    def _read_large_index(self, path: Path, data: bytes | bytearray) -> bool:
        """Read a landmark index without its entries becoming objects; tell whether that was done."""
        entry = pb.LandmarkIndexEntry.DESCRIPTOR.fields_by_name
        ids = ids_of_parts(
            data,
            pb.VIMap.DESCRIPTOR.fields_by_name["landmark_index"].number,
            (entry["vertex_id"].number, entry["landmark_id"].number),
        )
        if ids is None:
            return False
        self._ids.setdefault("index_vertex_ids", []).append(ids[0])
        self._ids.setdefault("index_landmark_ids", []).append(ids[1])
        self._index_path = self._index_path or path
        self.facts.append(FileFacts(FileKind.LANDMARK_INDEX, path, False, False, False))
        return True

    def content(self) -> tables_from_messages.Content:
        """Return the entities of all files."""
        paths = tuple(facts.path for facts in self.facts)
        starts = starts_of_counts(np.array([part.count for part in self.vertices], dtype=np.int64))
        listed = {}
        for field in vertex_parts.LISTED_EDGES:
            pairs = [part.listed[field] for part in self.vertices]
            owners = [owner + start for (owner, _), start in zip(pairs, starts[:-1], strict=True)]
            listed[field] = (
                _stacked(owners, np.zeros(0, dtype=np.int64)),
                _stacked([i for _, i in pairs], _NO_IDS),
            )
        ids = {name: _stacked(parts, _NO_IDS) for name, parts in self._ids.items()}
        return tables_from_messages.Content(
            vertex_ids=ids["vertex_ids"],
            vertex_mission_ids=_stacked([part.mission_ids for part in self.vertices], _NO_IDS),
            listed_edges=listed,
            edge_ids=ids["edge_ids"],
            mission_ids=ids["mission_ids"],
            baseframe_ids=ids["baseframe_ids"],
            legacy_landmark_ids=ids["legacy_landmark_ids"],
            index_vertex_ids=ids["index_vertex_ids"],
            index_landmark_ids=ids["index_landmark_ids"],
            paths=paths,
            index_path=self._index_path or paths[0].parent,
            file_of={
                ENTITIES[name]: _stacked(parts, np.zeros(0, dtype=np.int64))
                for name, parts in self._file_of.items()
            },
            **self._entities,
        )


def _stacked(arrays: Sequence[Any], empty: Any) -> Any:
    return np.concatenate(arrays) if arrays else empty
