"""The descriptor index at 100,000 descriptors: build, time of a frame, recall, peers of its kind.

python -m tests.benchmarks.index
"""

from __future__ import annotations

import argparse
import dataclasses
import time

import numba
import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.vision.index import DescriptorSet, MatchRule, make_index
from maplab_py.vision.multi_index import InvertedMultiIndex
from tests.support.machine import slowness
from tests.vision.synthetic import descriptor_set, tracks

DESCRIPTORS, FRAME, FRAMES, TRACK = 100_000, 500, 20, 5
WORDS = LoopClosureOptions().num_words_for_nn_search  # cells per query


@dataclasses.dataclass(frozen=True)
class IndexFigures:
    """What was measured; wall times, but for the processor's."""

    descriptors: int
    build_s: float
    query_ms: float  # median over frames of FRAME features, as lc searches (ranked by bits)
    query_projected_ms: float  # ranked in projected space
    query_processor_ms: float  # the same on one thread, processor time: whatever else is running
    slowness: float  # of the machine around that
    recall: float  # of the nearest in projected space, against the KD-tree
    tree_ms: float  # the exact KD-tree, per frame


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


def measure(descriptors: int = DESCRIPTORS) -> IndexFigures:
    """Measure; kernels are compiled before."""
    database, frames = make_database(descriptors)
    warm = database.take(np.arange(2000))
    for by_bits in (True, False):
        small = InvertedMultiIndex(warm, cells_per_query=WORDS, rank_by_bits=by_bits)
        small.nearest(frames.take(np.arange(10)), 3, MatchRule())
    begin = time.perf_counter()
    index = InvertedMultiIndex(database, cells_per_query=WORDS)
    build_s = time.perf_counter() - begin
    bits_ms, _ = _query_all(index, frames)
    before = slowness()
    processor_ms = _processor_ms(index, frames)
    factor = (before + slowness()) / 2
    projected = InvertedMultiIndex(database, cells_per_query=WORDS, rank_by_bits=False)
    projected_ms, found = _query_all(projected, frames)
    tree = make_index("kd", database, seed=0, words_per_query=0)
    tree_ms, exact = _query_all(tree, frames)
    return IndexFigures(
        descriptors=len(database),
        build_s=build_s,
        query_ms=float(np.median(bits_ms)),
        query_projected_ms=float(np.median(projected_ms)),
        query_processor_ms=processor_ms,
        slowness=factor,
        recall=float(np.mean(found <= exact * 1.0001 + 1e-6)),
        tree_ms=float(np.median(tree_ms)),
    )


def _query_all(index: object, frames: DescriptorSet) -> tuple[NDArray[np.float64], NDArray]:
    """Return times [ms] of the frames, and distances of the nearest."""
    ms, nearest = [], []
    for first in range(0, len(frames), FRAME):
        frame = frames.take(np.arange(first, min(first + FRAME, len(frames))))
        begin = time.perf_counter()
        found = index.nearest(frame, 3, MatchRule())  # type: ignore[attr-defined]
        ms.append(1e3 * (time.perf_counter() - begin))
        nearest.append(found.distance[:, 0])
    return np.array(ms), np.concatenate(nearest)


def _processor_ms(index: InvertedMultiIndex, frames: DescriptorSet) -> float:
    """Return the processor time [ms] of a frame on one thread (median)."""
    threads, ms = numba.get_num_threads(), []
    numba.set_num_threads(1)
    try:
        for first in range(0, len(frames), FRAME):
            frame = frames.take(np.arange(first, min(first + FRAME, len(frames))))
            begin = time.thread_time()
            index.nearest(frame, 3, MatchRule())
            ms.append(1e3 * (time.thread_time() - begin))
    finally:
        numba.set_num_threads(threads)
    return float(np.median(ms))


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--descriptors", type=int, default=DESCRIPTORS)
    f = measure(parser.parse_args().descriptors)
    print(
        f"{f.descriptors} descriptors, {WORDS} cells: built in {f.build_s:.2f} s; a frame of {FRAME} "
        f"features {f.query_ms:.1f} ms; processor, one thread: {f.query_processor_ms:.1f} ms on a "
        f"machine {f.slowness:.2f} times slower than an ordinary one, so "
        f"{f.query_processor_ms / f.slowness:.1f} ms there; ranked in projected space "
        f"{f.query_projected_ms:.1f} ms with recall@1 {100 * f.recall:.1f} % against the exact "
        f"KD-tree ({f.tree_ms:.1f} ms)"
    )


if __name__ == "__main__":
    main()
