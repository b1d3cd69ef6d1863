"""The connected parts of a graph, compiled: scipy's take longer than a small pose graph's solution."""

from __future__ import annotations

import numpy as np

from maplab_py.compilation import compiled


@compiled()
def connected_parts(count, first, second):  # type: ignore[no-untyped-def]
    """Return the smallest node (count,) of each node's part, links being first (E,) to second."""
    root = np.arange(count)
    for link in range(len(first)):
        a, b = first[link], second[link]
        while root[a] != a:
            root[a] = root[root[a]]
            a = root[a]
        while root[b] != b:
            root[b] = root[root[b]]
            b = root[b]
        if a < b:
            root[b] = a
        else:
            root[a] = b
    for node in range(count):
        root[node] = root[root[node]]
    return root
