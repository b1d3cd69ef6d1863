"""Compiled kernels that compare descriptors: differences and the searches of the indices.

Queries and database descriptors are `index.DescriptorColumns`: equal labels and, within a session,
near times are no match. A search keeps the k nearest of distinct labels.
"""

from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F32, I64
from maplab_py.compilation import compiled, prange

_SIGNED_BYTE = np.dtype(np.int8)


class Cells(NamedTuple):
    """Cells of a multi-index, and how a query walks them."""

    first_centres: F32  # (A, dimensions / 2) words of the even dimensions
    second_centres: F32  # (B, dimensions / 2) words of the odd dimensions
    start: I64  # (A B + 1,) offsets of the cells' descriptors
    per_query: int  # cells that a query visits
    rank_by_bits: bool  # whether distances are bits, else squared distances in projected space


@compiled(forceinline=True)
def _popcount(x):  # type: ignore[no-untyped-def]
    """Return the number of set bits of a 64-bit word (SWAR, which LLVM turns into popcnt)."""
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (x * np.uint64(0x0101010101010101)) >> np.uint64(56)


@compiled(forceinline=True)
def difference(a, i, b, j):  # type: ignore[no-untyped-def]
    """Return the number of different bits of packed words, the squared distance of signed bytes."""
    # indices, as taking rows out would count references: that costs more than the comparison
    if a.dtype == _SIGNED_BYTE:  # decided when compiled, unlike a test of a.itemsize
        total = np.int32(0)
        for w in range(a.shape[1]):
            step = np.int32(a[i, w]) - np.int32(b[j, w])
            total += step * step
        return np.uint64(total)
    bits = np.uint64(0)
    for w in range(a.shape[1]):
        bits += _popcount(np.uint64(a[i, w] ^ b[j, w]))
    return bits


@compiled(parallel=True)
def differences_between(words_a, rows_a, words_b, rows_b, distance):  # type: ignore[no-untyped-def]
    """Fill in the differences between rows of two tables."""
    for i in prange(len(rows_a)):
        distance[i] = difference(words_a, rows_a[i], words_b, rows_b[i])


@compiled()
def _insert(row, distance, labels, candidate, label, value):  # type: ignore[no-untyped-def]
    """Put a candidate into a sorted list of the nearest ones that holds every label once."""
    place = len(row) - 1
    for i in range(len(row)):
        if row[i] >= 0 and labels[i] == label:
            if value >= distance[i]:
                return
            place = i
            break
    while place > 0 and distance[place - 1] > value:
        row[place], distance[place] = row[place - 1], distance[place - 1]
        labels[place] = labels[place - 1]
        place -= 1
    row[place], distance[place], labels[place] = candidate, value, label


@compiled(forceinline=True)
def _allowed(queries, q, database, d, rule):  # type: ignore[no-untyped-def]
    label = queries.label[q]
    if database.label[d] == label and label >= 0:
        return False
    if database.session[d] != queries.session[q]:
        return True
    near = abs(database.time_ns[d] - queries.time_ns[q]) < rule.min_time_ns
    return not (rule.other_sessions_only or near)


@compiled()
def _word_distances(point, offset, centres, result):  # type: ignore[no-untyped-def]
    """Fill in squared distances of one half (every other dimension) to the words."""
    for w in range(len(centres)):
        total = np.float32(0.0)
        for d in range(centres.shape[1]):
            difference = point[offset + 2 * d] - centres[w, d]
            total += difference * difference
        result[w] = total


@compiled()
def _nearest_first(distance, order):  # type: ignore[no-untyped-def]
    """Fill in the words of the smallest distances, nearest first; few of many, so nothing is sorted."""
    size = len(order)
    for word in range(len(distance)):
        place = min(word, size - 1)
        if word >= size and distance[word] >= distance[order[place]]:
            continue
        while place > 0 and distance[order[place - 1]] > distance[word]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = word


@compiled(forceinline=True)
def _next_cell(distance_a, order_a, distance_b, order_b, next_b, reach):  # type: ignore[no-untyped-def]
    """Return the rank of the next word of a in the multi-sequence walk, -1 at its end.

    next_b[i] is the rank of the word of b that is to be paired with the i-th word of a.
    """
    best, best_value = -1, np.float32(np.inf)
    for i in range(reach):
        if next_b[i] < len(order_b):
            value = distance_a[order_a[i]] + distance_b[order_b[next_b[i]]]
            if value < best_value:
                best, best_value = i, value
    return best


@compiled(forceinline=True)
def _squared_distance(a, i, b, j, limit):  # type: ignore[no-untyped-def]
    """Return the squared distance, or only a part of it where that reaches the limit already."""
    total = np.float32(0.0)
    half = a.shape[1] // 2
    for k in range(half):
        difference = a[i, k] - b[j, k]
        total += difference * difference
    if total >= limit:
        return total
    for k in range(half, a.shape[1]):
        difference = a[i, k] - b[j, k]
        total += difference * difference
    return total


@compiled(parallel=True)
def search_cells(  # type: ignore[no-untyped-def]
    query_points, queries, cells, points, database, rule, row, distance
):
    """Walk the nearest cells of a multi-index; compare inside by bits or in projected space.

    `distance` comes filled with a bound that neighbours must stay below.
    """
    words_a, words_b, k = len(cells.first_centres), len(cells.second_centres), row.shape[1]
    for q in prange(len(query_points)):
        distance_a = np.empty(words_a, dtype=np.float32)
        distance_b = np.empty(words_b, dtype=np.float32)
        _word_distances(query_points[q], 0, cells.first_centres, distance_a)
        _word_distances(query_points[q], 1, cells.second_centres, distance_b)
        order_a = np.empty(min(cells.per_query, words_a), dtype=np.int64)
        order_b = np.empty(min(cells.per_query, words_b), dtype=np.int64)
        _nearest_first(distance_a, order_a)
        _nearest_first(distance_b, order_b)
        next_b = np.zeros(words_a, dtype=np.int32)
        reach = 1
        labels = np.full(k, -1, dtype=np.int64)
        for _ in range(cells.per_query):
            best = _next_cell(distance_a, order_a, distance_b, order_b, next_b, reach)
            if best < 0:
                break
            cell = order_a[best] * words_b + order_b[next_b[best]]
            next_b[best] += 1
            if best == reach - 1 and reach < len(order_a):
                reach += 1
            for d in range(cells.start[cell], cells.start[cell + 1]):
                if cells.rank_by_bits:
                    value = np.float32(difference(queries.words, q, database.words, d))
                else:
                    value = _squared_distance(query_points, q, points, d, distance[q, k - 1])
                if value < distance[q, k - 1] and _allowed(queries, q, database, d, rule):
                    _insert(row[q], distance[q], labels, d, database.label[d], value)
