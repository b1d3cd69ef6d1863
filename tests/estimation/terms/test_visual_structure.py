"""The blocks that landmarks fill, against a plain enumeration of all pairs."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.estimation.terms import visual_structure
from maplab_py.estimation.terms.visual_structure import EliminationPlan, elimination_plan
from maplab_py.vimap.table import starts_of_counts


def _random_tracks(seed: int) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    tracks = [np.sort(rng.integers(0, 10, rng.integers(0, 7))) for _ in range(40)]
    start = starts_of_counts(np.array([len(track) for track in tracks]))
    return tracks, start, np.concatenate(tracks).astype(np.int32)


@pytest.mark.parametrize("seed", range(5))
def test_every_pair_has_its_block(seed: int) -> None:
    num_vertices = 12  # two of which see nothing
    tracks, start, vertex = _random_tracks(seed)
    plan = elimination_plan(start, vertex, num_vertices)
    pairs = [
        (track[b], track[a]) for track in tracks for b in range(len(track)) for a in range(b + 1)
    ]
    wanted = sorted({(int(b), int(a)) for b, a in pairs} | {(v, v) for v in range(num_vertices)})
    assert list(zip(plan.rows.tolist(), plan.cols.tolist(), strict=True)) == wanted


@pytest.mark.parametrize("seed", range(5))
def test_all_work_is_shared_out_once(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visual_structure, "_SMALL_SLAB", 20)
    _, start, vertex = _random_tracks(seed)
    plan = elimination_plan(start, vertex, 12)
    assert len(plan.slab_start) > 4
    assert plan.largest_slab == np.diff(start[plan.slab_start]).max()
    np.testing.assert_array_equal(plan.chunk_start[:, 0], plan.slab_start[:-1])
    np.testing.assert_array_equal(plan.chunk_start[:, -1], plan.slab_start[1:])
    assert (np.diff(plan.chunk_start, axis=1) >= 0).all()
    assert (np.diff(plan.piece_start, axis=1) >= 0).all()
    np.testing.assert_array_equal(plan.piece_start[:, [0, -1]], [[0, 12]] * len(plan.piece_start))
    np.testing.assert_array_equal(np.sort(plan.views), np.arange(len(vertex)))
    _check_views(plan, start, vertex)


def _check_views(plan: EliminationPlan, start: np.ndarray, vertex: np.ndarray) -> None:
    for slab, offsets in enumerate(plan.view_start):
        low, high = start[plan.slab_start[slab]], start[plan.slab_start[slab + 1]]
        assert (offsets[0], offsets[-1]) == (low, high)
        for v in range(len(offsets) - 1):
            wanted = low + np.flatnonzero(vertex[low:high] == v)
            np.testing.assert_array_equal(plan.views[offsets[v] : offsets[v + 1]], wanted)


def test_no_landmarks_leave_the_diagonal() -> None:
    plan = elimination_plan(np.zeros(1, dtype=np.int64), np.zeros(0, dtype=np.int32), 3)
    np.testing.assert_array_equal(plan.rows, [0, 1, 2])
    np.testing.assert_array_equal(plan.cols, [0, 1, 2])
    assert plan.largest_slab == 0
