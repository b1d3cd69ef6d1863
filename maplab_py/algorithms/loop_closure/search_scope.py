"""Scope of a search for loop closures in a growing map, without the results of earlier searches."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import I64, U8, Mask
from maplab_py.vision.descriptor_kind import DescriptorKind
from maplab_py.vision.projection import DescriptorProjection, learn_projection

_GROWTH = 2
"""The projection is learned again where there are so many times as many tracked descriptors."""


class ProjectionMemory:
    """The descriptor projection of a growing map.

    A projection is good for descriptors that it was not learned from, and learning it takes longer than
    a search for the places of a few vertices. So it is learned again only for other descriptors, or when
    there is twice as much to learn from as the last time.
    """

    def __init__(self) -> None:
        """Start without a projection."""
        self._projection: DescriptorProjection | None = None
        self._descriptors = 0

    def learned(
        self, descriptors: U8, track: I64, kind: DescriptorKind, dimensions: int
    ) -> DescriptorProjection:
        """Return the kept projection, or learn one; see `learn_projection`.

        Raises:
            EstimationError: Too few tracks.
        """
        count = int(np.count_nonzero(track >= 0))
        kept = self._projection
        if kept is not None and kept.kind == kind and count <= _GROWTH * self._descriptors:
            wanted = min(dimensions, kind.dimensions)
            if len(kept.matrix) == wanted:
                return kept
        learned = learn_projection(descriptors, track, kind=kind, dimensions=dimensions)
        self._projection, self._descriptors = learned, count
        return learned


@dataclasses.dataclass(frozen=True)
class SearchScope:
    """Limits of a search.

    Attributes:
        queries: Vertices (V,) whose places are looked for, in the whole map; None = all.
        projections: Keeps the projection from one search to the next; None = it is learned.
    """

    queries: Mask | None = None
    projections: ProjectionMemory | None = None
