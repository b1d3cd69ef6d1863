"""Queries from a map: the images of each vertex, alone or with those of the vertices before it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from maplab_py.algorithms.localization.localizer import Query
from maplab_py.algorithms.loop_closure.features import MapFeatures, map_features
from maplab_py.array_types import I64
from maplab_py.geometry import se3, so3
from maplab_py.vimap import VIMap
from maplab_py.vimap.descriptors import sizes_of_type
from maplab_py.vimap.table import starts_of_counts
from maplab_py.vision.projection import DescriptorProjection


@dataclasses.dataclass(frozen=True, eq=False)
class QueryVertices:
    """Features of the vertices to be localised, grouped by vertex."""

    vi_map: VIMap
    features: MapFeatures
    start: I64  # (V + 1,) features of each vertex of the map
    vertex: I64  # (Q,) vertices to be localised


def query_vertices(vi_map: VIMap, missions: I64, projection: DescriptorProjection) -> QueryVertices:
    """Collect the features of all vertices of some missions.

    Raises:
        EstimationError: The map has no descriptors, or others than the projection takes.
    """
    kind = projection.kind
    has_kind = sizes_of_type(vi_map.frames, kind.feature_type, kind.depth) == kind.size
    features, _ = map_features(
        vi_map,
        missions,
        projection=projection,
        feature_type=kind.feature_type,
        sizes=(kind.size,) if has_kind.any() else (),
    )
    counts = np.bincount(features.vertex, minlength=len(vi_map.vertices))
    chosen = np.isin(vi_map.vertices.mission, missions)
    return QueryVertices(vi_map, features, starts_of_counts(counts), np.flatnonzero(chosen))


def queries(source: QueryVertices, sequence_length: int = 1) -> Iterator[Query]:
    """Yield one query per vertex.

    With a sequence length of n, the images of the n - 1 preceding vertices of the same mission are
    treated as those of one rig whose extrinsics are the relative poses of the map.
    """
    vi_map = source.vi_map
    first_of_mission = vi_map.vertex_start[vi_map.vertices.mission]
    size = source.features.kind.size
    for vertex in source.vertex.tolist():
        first = max(vertex - sequence_length + 1, int(first_of_mission[vertex]))
        rows = np.arange(source.start[first], source.start[vertex + 1])
        features = source.features
        T_V_I = se3.relative(
            vi_map.vertices.T_M_I[vertex], vi_map.vertices.T_M_I[features.vertex[rows]]
        )
        yield Query(
            key=vertex,
            descriptors=vi_map.keypoints.descriptor[features.keypoint[rows], :size],
            origin_I=se3.transform(T_V_I, features.origin_I[rows]),
            ray_I=so3.rotate(T_V_I[:, :4], features.ray_I[rows]),
            rad_per_px=features.rad_per_px[rows],
            q_M_I=vi_map.vertices.T_M_I[vertex, :4],
        )
