"""The blocks that landmarks fill, against a plain enumeration of all pairs."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.estimation.visual_structure import reduced_blocks
from maplab_py.vimap.table import starts_of_counts


@pytest.mark.parametrize("seed", range(5))
def test_every_pair_finds_its_block(seed: int) -> None:
    rng = np.random.default_rng(seed)
    num_vertices = 12
    tracks = [np.sort(rng.integers(0, num_vertices - 2, rng.integers(0, 7))) for _ in range(40)]
    counts = np.array([len(track) for track in tracks])
    start, pair_start = starts_of_counts(counts), starts_of_counts(counts * (counts + 1) // 2)
    vertex = np.concatenate(tracks).astype(np.int32)
    row, col, pair_block, diagonal = reduced_blocks(start, vertex, pair_start, num_vertices)
    pairs = [
        (track[b], track[a]) for track in tracks for b in range(len(track)) for a in range(b + 1)
    ]
    wanted = sorted({(int(b), int(a)) for b, a in pairs} | {(v, v) for v in range(num_vertices)})
    assert list(zip(row.tolist(), col.tolist(), strict=True)) == wanted
    found = np.column_stack([row[pair_block], col[pair_block]])
    np.testing.assert_array_equal(found, np.array(pairs))
    every = np.arange(num_vertices)
    np.testing.assert_array_equal(row[diagonal], every)
    np.testing.assert_array_equal(col[diagonal], every)


def test_no_landmarks_leave_the_diagonal() -> None:
    nothing = np.zeros(1, dtype=np.int64)
    row, col, pair_block, diagonal = reduced_blocks(
        nothing, np.zeros(0, dtype=np.int32), nothing, 3
    )
    np.testing.assert_array_equal(row, [0, 1, 2])
    np.testing.assert_array_equal(col, [0, 1, 2])
    np.testing.assert_array_equal(diagonal, [0, 1, 2])
    assert len(pair_block) == 0
