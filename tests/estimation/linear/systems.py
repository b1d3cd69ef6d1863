"""Random symmetric positive definite block systems of many structures."""

import numpy as np
from numpy.typing import NDArray

STRUCTURES = (
    "one node",
    "singletons",
    "chain",
    "star",
    "dense",
    "ring",
    "two components",
    "random",
    "cameras",
)


def structure(name: str, rng: np.random.Generator) -> tuple[int, NDArray[np.int64]]:
    """Return the number of nodes and the off-diagonal node pairs (P, 2)."""
    if name == "one node":
        return 1, np.zeros((0, 2), dtype=np.int64)
    if name == "singletons":
        return 7, np.zeros((0, 2), dtype=np.int64)
    if name == "chain":
        return 40, np.array([(i + 1, i) for i in range(39)])
    if name == "star":
        return 30, np.array([(i, 0) for i in range(1, 30)])
    if name == "dense":
        return 15, np.array([(i, j) for i in range(15) for j in range(i)])
    if name == "ring":
        return 33, np.array([(i + 1, i) for i in range(32)] + [(32, 0)])
    if name == "two components":
        left = [(i + 1, i) for i in range(12)]
        return 26, np.array(left + [(i + 14, i + 13) for i in range(11)])  # node 25 is alone
    if name == "random":
        pairs = rng.integers(0, 60, size=(150, 2))
        return 60, pairs[pairs[:, 0] != pairs[:, 1]]
    pairs = [(i, i - k) for k in range(1, 6) for i in range(k, 80)]
    return 80, np.array([*pairs, (75, 2), (74, 3), (60, 20)])


def system(
    name: str, node_size: int, seed: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], int, NDArray[np.float64], NDArray[np.float64]]:
    """Return block rows, block columns, number of nodes, block values and the dense matrix."""
    rng = np.random.default_rng(seed)
    n, pairs = structure(name, rng)
    shuffle = rng.permutation(n)
    pairs = np.sort(shuffle[pairs], axis=1)[:, ::-1]
    diagonal = np.repeat(np.arange(n)[:, None], 2, axis=1)
    blocks = np.concatenate([pairs, diagonal])
    blocks = blocks[rng.permutation(len(blocks))]  # duplicates of "random" stay: they are added
    rows, cols = blocks[:, 0], blocks[:, 1]
    d = node_size
    values = rng.normal(size=(len(blocks), d, d))
    on_diagonal = rows == cols
    values[on_diagonal] += np.eye(d) * (8.0 * d * (2 + np.bincount(rows).max() + n / 10))
    dense = np.zeros((n * d, n * d))
    for row, col, value in zip(rows, cols, values, strict=True):
        here = dense[row * d : row * d + d, col * d : col * d + d]
        here += np.tril(value) + np.tril(value, -1).T if row == col else value
    lower = np.tril(dense)
    return rows, cols, n, values, lower + np.tril(lower, -1).T
