"""Triangles in a tree of boxes, which finds the one nearest to a point."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.dense.distance.triangle_kernels import distances_of_points
from maplab_py.array_types import F64, I32, I64
from maplab_py.errors import EstimationError
from maplab_py.memory import require_memory

_LEAF = 4
"""Triangles in a box are at most so many."""
_MIN_SQUARED_SINE = 1e-14
_BYTES_PER_TRIANGLE = 400
"""Memory that building the tree takes at most."""


class TriangleTree:
    """Exact distances of points from a triangle mesh.

    The triangles are halved along the longest side of their box again and again (a bounding volume
    hierarchy). A point looks only into boxes that are nearer than the nearest triangle so far.
    """

    def __init__(self, p: F64, faces: I32) -> None:
        """Build the tree of triangles (F, 3) between vertices (N, 3).

        Raises:
            EstimationError: There are no triangles.
            NotEnoughMemory: The tree does not fit into the allowed memory.
        """
        if not len(faces):
            raise EstimationError("a mesh without triangles has no distances")
        require_memory(len(faces) * _BYTES_PER_TRIANGLE, "the search tree of a mesh")
        corners = _with_slivers_as_segments(np.array(p[faces], dtype=np.float64))
        leaves = 1 << int(np.ceil(np.log2(max(len(faces) / _LEAF, 1.0))))
        size = -(-len(faces) // leaves)  # rounded up
        # repeated triangles fill the last leaves
        rows = np.concatenate([np.arange(len(faces)), np.zeros(leaves * size - len(faces), int)])
        rows = _halve(corners.mean(axis=1), rows, leaves)
        self._triangles = corners[rows].reshape(-1, 9)
        self._boxes = _boxes(corners[rows].reshape(leaves, -1, 3))

    def distances(self, points: F64, limit: float = np.inf) -> F64:
        """Return the distances (N,) of points (N, 3) from the mesh, at most the limit.

        They are exact up to the rounding of double precision. Points in the order of a path or of
        blocks are faster than points at random.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        distance = np.empty(len(points))
        distances_of_points(points, self._boxes, self._triangles, float(limit), distance)
        return distance


def _with_slivers_as_segments(corners: F64) -> F64:
    """Reduce triangles (F, 3, 3) without area to their longest side: the third corner is the first.

    The kernel would otherwise choose any of their sides.
    """
    sides = np.roll(corners, -1, axis=1) - corners
    lengths = np.sum(sides**2, axis=2)
    area = np.sum(np.cross(sides[:, 0], sides[:, 1]) ** 2, axis=1)
    slivers = np.flatnonzero(area <= _MIN_SQUARED_SINE * np.max(lengths, axis=1) ** 2)
    first = np.argmax(lengths[slivers], axis=1)
    a, b = corners[slivers, first], corners[slivers, (first + 1) % 3]
    corners[slivers] = np.stack([a, b, a], axis=1)
    return corners


def _halve(centres: F64, rows: I64, leaves: int) -> I64:
    """Order triangles (rows) so that equal parts of them are the leaves of a tree."""
    groups = rows[None]
    while len(groups) < leaves:
        c = centres[groups]
        axis = np.argmax(np.ptp(c, axis=1), axis=1)
        along = np.take_along_axis(c, axis[:, None, None], axis=2)[:, :, 0]
        order = np.argsort(along, axis=1, kind="stable")
        groups = np.take_along_axis(groups, order, axis=1).reshape(2 * len(groups), -1)
    return groups.reshape(-1)


def _boxes(points: F64) -> F64:
    """Return the tree of boxes (2 L, 6) of the points (L, K, 3) in its leaves; box 0 is not used."""
    leaves = len(points)
    boxes = np.zeros((2 * leaves, 6))
    boxes[leaves:, :3], boxes[leaves:, 3:] = points.min(axis=1), points.max(axis=1)
    while leaves > 1:
        children = boxes[leaves : 2 * leaves].reshape(-1, 2, 6)
        leaves //= 2
        boxes[leaves : 2 * leaves, :3] = children[:, :, :3].min(axis=1)
        boxes[leaves : 2 * leaves, 3:] = children[:, :, 3:].max(axis=1)
    return boxes
