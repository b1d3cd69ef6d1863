"""Distances of points from the triangles of a mesh, by a tree of boxes."""

import numpy as np

from maplab_py.array_types import F64, I32, I64
from maplab_py.compilation import compiled, prange
from maplab_py.errors import EstimationError
from maplab_py.memory import require_memory

_CHUNK = 256
"""Points of one thread at a time; the nearest triangle of one bounds the distance of the next."""
_STACK = 64
_SLACK = 1.0 + 1e-9
"""Bounds are larger by this factor, so that rounding does not hide the nearest triangle."""


@compiled()
def squared_distance_to_triangle(p: F64, triangle: F64) -> float:
    """Return the squared distance of a point (3,) from a triangle (9,): its corners in a row.

    Source: Ericson, Real-Time Collision Detection, 2005, section 5.1.5.
    """
    abx, aby, abz = triangle[3] - triangle[0], triangle[4] - triangle[1], triangle[5] - triangle[2]
    acx, acy, acz = triangle[6] - triangle[0], triangle[7] - triangle[1], triangle[8] - triangle[2]
    apx, apy, apz = p[0] - triangle[0], p[1] - triangle[1], p[2] - triangle[2]
    d1 = abx * apx + aby * apy + abz * apz
    d2 = acx * apx + acy * apy + acz * apz
    bpx, bpy, bpz = p[0] - triangle[3], p[1] - triangle[4], p[2] - triangle[5]
    d3 = abx * bpx + aby * bpy + abz * bpz
    d4 = acx * bpx + acy * bpy + acz * bpz
    cpx, cpy, cpz = p[0] - triangle[6], p[1] - triangle[7], p[2] - triangle[8]
    d5 = abx * cpx + aby * cpy + abz * cpz
    d6 = acx * cpx + acy * cpy + acz * cpz
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    s, t = 0.0, 0.0  # the nearest point is a + s ab + t ac
    if d1 <= 0.0 and d2 <= 0.0:
        pass
    elif d3 >= 0.0 and d4 <= d3:
        s = 1.0
    elif d6 >= 0.0 and d5 <= d6:
        t = 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s = d1 / (d1 - d3)
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6)
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        s = 1.0 - t
    else:
        s, t = vb / (va + vb + vc), vc / (va + vb + vc)
    x, y, z = apx - s * abx - t * acx, apy - s * aby - t * acy, apz - s * abz - t * acz
    squared: float = x * x + y * y + z * z
    return squared


@compiled()
def squared_distance_to_box(p: F64, box: F64) -> float:
    """Return the squared distance of a point (3,) from a box (6,): its lower and its upper corner."""
    total = 0.0
    for axis in range(3):
        beyond = max(box[axis] - p[axis], p[axis] - box[axis + 3], 0.0)
        total += beyond * beyond
    return total


@compiled()
def nearest_squared(p: F64, boxes: F64, triangles: F64, bound: float, stack: F64) -> float:
    """Return the squared distance of a point (3,) from the nearest triangle, at most the bound.

    Args:
        p: Point.
        boxes: Tree (2 L, 6): box 1 contains all triangles, box n contains the boxes 2 n and 2 n + 1, and
            box L + n the triangles n k to n k + k - 1.
        triangles: Triangles (L k, 9).
        bound: Squared distance beyond which triangles do not count.
        stack: Space (_STACK, 2) for boxes that are still to be searched.
    """
    leaves = len(boxes) // 2
    size = len(triangles) // leaves
    stack[0, 0], stack[0, 1] = 1.0, squared_distance_to_box(p, boxes[1])
    waiting = 1
    while waiting:
        waiting -= 1
        if stack[waiting, 1] >= bound:
            continue
        node = int(stack[waiting, 0])
        if node >= leaves:
            for row in range((node - leaves) * size, (node - leaves + 1) * size):
                bound = min(bound, squared_distance_to_triangle(p, triangles[row]))
            continue
        first = squared_distance_to_box(p, boxes[2 * node])
        second = squared_distance_to_box(p, boxes[2 * node + 1])
        nearer = int(second < first)
        # the nearer box is taken from the stack first
        stack[waiting, 0], stack[waiting, 1] = 2 * node + 1 - nearer, max(first, second)
        stack[waiting + 1, 0], stack[waiting + 1, 1] = 2 * node + nearer, min(first, second)
        waiting += 2
    return bound


@compiled(parallel=True)
def distances_of_points(
    points: F64, boxes: F64, triangles: F64, limit: float, distance: F64
) -> None:
    """Enter the distances (N,) of points (N, 3) from the nearest triangle, at most the limit.

    Args:
        points: Points; those that follow one another should be neighbours.
        boxes: See `nearest_squared`.
        triangles: See `nearest_squared`.
        limit: Largest distance of interest.
        distance: Distances to fill.
    """
    for chunk in prange((len(points) + _CHUNK - 1) // _CHUNK):
        stack = np.empty((_STACK, 2))
        known = limit
        for row in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(points))):
            if row > chunk * _CHUNK:
                # distances of two points differ by no more than the points' distance
                x, y, z = points[row] - points[row - 1]
                known = min(limit, distance[row - 1] + np.sqrt(x * x + y * y + z * z))
            bound = _SLACK * known * known
            distance[row] = min(
                limit, np.sqrt(nearest_squared(points[row], boxes, triangles, bound, stack))
            )


def compile_kernels() -> None:
    """Compile the kernels of this module for the types that are used."""
    boxes = np.tile(np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0]), (2, 1))
    triangles = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]])
    distances_of_points(np.ones((1, 3)), boxes, triangles, 9.0, np.zeros(1))


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
