"""The descriptor index at 100,000 descriptors: build, time of a frame, recall, exact peers.

python -m benchmarks.index [--cells 32 24 16 12] [--descriptors 100000]
"""

import argparse
import dataclasses
import time

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.vision.index import DescriptorSet, InvertedMultiIndex, MatchRule
from tests.support.machine import slowness
from tests.vision.synthetic import descriptor_set, nearest_by_bits, tracks

F64 = NDArray[np.float64]
DESCRIPTORS, FRAME, FRAMES, TRACK = 100_000, 500, 20, 5
EXACT_FRAMES = 4  # searched exactly


@dataclasses.dataclass(frozen=True)
class IndexFigures:
    """What was measured of the multi-index with some number of cells."""

    cells: int
    build_s: float
    processor_ms: float  # a frame as lc searches it, on one thread, median
    slowness: float  # of the machine around that
    recall_projected: float  # of the nearest in projected space, against the KD-tree
    recall_bits: float  # of the nearest by bits, against the search of all


@dataclasses.dataclass(frozen=True)
class Exact:
    """Distances (N,) of the nearest of the first frames, and times of a frame [ms]."""

    projected: F64
    projected_ms: float
    bits: F64
    bits_ms: float


def make_database(
    descriptors: int = DESCRIPTORS, seed: int = 3
) -> tuple[DescriptorSet, DescriptorSet]:
    """Return a database and the descriptors of frames that see parts of it once more."""
    raw, label = tracks(descriptors // TRACK, TRACK + 1, flips=0.08, seed=seed)
    both = descriptor_set(raw, label)
    again = np.arange(len(label)) % (TRACK + 1) == TRACK
    queries = np.random.default_rng(seed).permutation(np.flatnonzero(again))[: FRAME * FRAMES]
    frames = both.take(queries)
    # a query has no landmark yet: nothing is left out
    frames = dataclasses.replace(frames, label=np.full(len(queries), -1))
    return both.take(np.flatnonzero(~again)), frames


def search_exactly(database: DescriptorSet, frames: DescriptorSet) -> Exact:
    """Search the first frames by scipy's KD-tree, and by comparing all bits in numpy."""
    few, tree = frames.take(np.arange(EXACT_FRAMES * FRAME)), cKDTree(database.projected)
    begin = time.thread_time()
    distance, _ = tree.query(few.projected, k=3)
    between = time.thread_time()
    bits = nearest_by_bits(database, few)
    tree_ms, bits_ms = 1e3 * (between - begin), 1e3 * (time.thread_time() - between)
    nearest = distance[:, 0] ** 2, bits.astype(np.float64)
    return Exact(nearest[0], tree_ms / EXACT_FRAMES, nearest[1], bits_ms / EXACT_FRAMES)


def measure(
    database: DescriptorSet, frames: DescriptorSet, exact: Exact, cells: int
) -> IndexFigures:
    """Measure the multi-index; kernels are compiled before."""
    warm = database.take(np.arange(2000))
    few = frames.take(np.arange(EXACT_FRAMES * FRAME))
    for by_bits in (True, False):
        small = InvertedMultiIndex(warm, cells_per_query=cells, rank_by_bits=by_bits)
        small.nearest(frames.take(np.arange(10)), 3, MatchRule())
    begin = time.perf_counter()
    index = InvertedMultiIndex(database, cells_per_query=cells)
    build_s = time.perf_counter() - begin
    before = slowness()
    processor_ms, found = _query(index, frames)
    factor = (before + slowness()) / 2
    projected = InvertedMultiIndex(database, cells_per_query=cells, rank_by_bits=False)
    _, found_projected = _query(projected, few)
    return IndexFigures(
        cells=cells,
        build_s=build_s,
        processor_ms=float(np.median(processor_ms)),
        slowness=factor,
        recall_projected=_share(found_projected, exact.projected),
        recall_bits=_share(found[: len(few)], exact.bits),
    )


def _share(found: F64, exact: F64) -> float:
    return float(np.mean(found <= exact * 1.0001 + 1e-6))


def _query(index: InvertedMultiIndex, frames: DescriptorSet) -> tuple[F64, F64]:
    """Return processor times [ms] of the frames on one thread, and distances of the nearest."""
    threads, ms, nearest = numba.get_num_threads(), [], []
    numba.set_num_threads(1)
    try:
        for first in range(0, len(frames), FRAME):
            frame = frames.take(np.arange(first, min(first + FRAME, len(frames))))
            begin = time.thread_time()
            found = index.nearest(frame, 3, MatchRule())
            ms.append(1e3 * (time.thread_time() - begin))
            nearest.append(found.distance[:, 0])
    finally:
        numba.set_num_threads(threads)
    return np.array(ms), np.concatenate(nearest)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = LoopClosureOptions().num_words_for_nn_search
    parser.add_argument("--cells", type=int, nargs="+", default=[default])
    parser.add_argument("--descriptors", type=int, default=DESCRIPTORS)
    arguments = parser.parse_args()
    database, frames = make_database(arguments.descriptors)
    exact = search_exactly(database, frames)
    print(
        f"{len(database)} descriptors, frames of {FRAME}; processor times of one thread; exact: "
        f"KD-tree {exact.projected_ms:.0f} ms, all by bits {exact.bits_ms:.0f} ms"
    )
    for cells in arguments.cells:
        f = measure(database, frames, exact, cells)
        print(
            f"{f.cells} cells: built in {f.build_s:.2f} s; a frame {f.processor_ms:.1f} ms on a "
            f"machine {f.slowness:.2f} times slower than an ordinary one, so "
            f"{f.processor_ms / f.slowness:.1f} ms there; recall@1 "
            f"{100 * f.recall_projected:.1f} % in projected space, {100 * f.recall_bits:.1f} % "
            f"by bits",
            flush=True,
        )


if __name__ == "__main__":
    main()
