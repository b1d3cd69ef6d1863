"""Choose observations of landmarks by information (compiled loops)."""

from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.compilation import compiled


class Sight(NamedTuple):
    """Observations (O,) grouped by landmark, and what they tell."""

    start: I64  # (L + 1,)
    vertex: I64  # (O,)
    direction: F64  # (O, 3) unit ray
    weight: F64  # (O,) inverse variance of the point across the ray [1/m^2]


class Links(NamedTuple):
    """Vertices that may share landmarks: those of v are other[start[v]] .. , ascending."""

    start: I64  # (V + 1,)
    other: I64


@compiled()
def choose(sight, links, limit, prior, chosen, count_of_vertex):  # type: ignore[no-untyped-def]
    """Fill in which observations (O,) are chosen; return the number left out by each limit.

    Landmark by landmark, the observation comes next that adds most to log det of the landmark's
    information plus log of its vertex's number of observations (D-optimality for both, the vertex's own
    information taken as proportional to that number).

    Args:
        sight: The observations.
        links: Vertices that may share landmarks; without entries all may.
        limit: Largest number of observations of a landmark; 0 = not limited.
        prior: Information of a landmark without observations [1/m^2].
        chosen: (O,) False at first.
        count_of_vertex: (V,) observations that are chosen already.

    Returns:
        Observations left out by `limit`, and by `links`.
    """
    over_limit, not_linked = 0, 0
    information = np.empty((3, 3))
    for landmark in range(len(sight.start) - 1):
        first, last = sight.start[landmark], sight.start[landmark + 1]
        candidate = np.ones(last - first, dtype=np.bool_)
        information[:] = 0.0
        for i in range(3):
            information[i, i] = prior
        taken = 0
        while limit == 0 or taken < limit:
            best = _most_informative(sight, first, candidate, information, count_of_vertex)
            if best < 0:
                break
            row = first + best
            candidate[best] = False
            chosen[row] = True
            count_of_vertex[sight.vertex[row]] += 1
            taken += 1
            _add(information, sight.direction[row], sight.weight[row])
            if len(links.start) > 1:
                for other in range(last - first):
                    if candidate[other] and not _is_linked(
                        links, sight.vertex[row], sight.vertex[first + other]
                    ):
                        candidate[other] = False
                        not_linked += 1
        for other in range(last - first):
            over_limit += candidate[other]
    return over_limit, not_linked


@compiled()
def _most_informative(sight, first, candidate, information, count):  # type: ignore[no-untyped-def]
    """Return the candidate that adds most information, -1 if there is none."""
    best, largest = -1, -np.inf
    before = _log_determinant(information)
    trial = np.empty((3, 3))
    for i in range(len(candidate)):
        if not candidate[i]:
            continue
        trial[:] = information
        _add(trial, sight.direction[first + i], sight.weight[first + i])
        seen = count[sight.vertex[first + i]]
        gain = _log_determinant(trial) - before + np.log((seen + 2.0) / (seen + 1.0))
        if gain > largest:
            best, largest = i, gain
    return best


@compiled(forceinline=True)
def _add(information, d, weight):  # type: ignore[no-untyped-def]
    """Add weight * (I - d d^T)."""
    for i in range(3):
        for j in range(3):
            information[i, j] += weight * ((1.0 if i == j else 0.0) - d[i] * d[j])


@compiled(forceinline=True)
def _log_determinant(A):  # type: ignore[no-untyped-def]
    a = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    b = A[1, 0] * A[2, 2] - A[1, 2] * A[2, 0]
    c = A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0]
    return np.log(A[0, 0] * a - A[0, 1] * b + A[0, 2] * c)


@compiled()
def _is_linked(links, a, b):  # type: ignore[no-untyped-def]
    """Return whether b is a or among the links of a."""
    if a == b:
        return True
    low, high = links.start[a], links.start[a + 1]
    while low < high:
        middle = (low + high) // 2
        if links.other[middle] < b:
            low = middle + 1
        else:
            high = middle
    return low < links.start[a + 1] and links.other[low] == b


@compiled()
def match_vertices(a, b, limit, degree, kept):  # type: ignore[no-untyped-def]
    """Keep pairs (N,) in order while both vertices have fewer than `limit` kept ones."""
    for pair in range(len(a)):
        if degree[a[pair]] < limit and degree[b[pair]] < limit:
            kept[pair] = True
            degree[a[pair]] += 1
            degree[b[pair]] += 1


def compile_kernels() -> None:
    """Compile the choice on one landmark of two observations."""
    start, vertex = np.array([0, 2]), np.arange(2)
    sight = Sight(start, vertex, np.eye(3)[:2].copy(), np.ones(2))
    links = Links(np.array([0, 1, 2]), vertex[::-1].copy())
    chosen, count = np.zeros(2, dtype=np.bool_), np.zeros(2, dtype=np.int64)
    choose(sight, links, 1, 1.0, chosen, count)
    match_vertices(vertex[:1], vertex[1:], 1, count, chosen)
