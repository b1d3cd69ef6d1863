"""The descriptor indices that can be chosen by name."""

from __future__ import annotations

import numpy as np

from maplab_py.vision.descriptor_kind import DescriptorKind
from maplab_py.vision.index import DescriptorIndex, DescriptorSet, MatchRule
from maplab_py.vision.projection import learn_projection

INDEX_ENGINES = ("imi", "kd", "hamming")
_SHORT = DescriptorKind(8)


def make_index(
    engine: str,
    database: DescriptorSet,
    *,
    seed: int,
    words_per_query: int,
    max_difference: float = np.inf,
) -> DescriptorIndex:
    """Build an index.

    Args:
        engine: One of INDEX_ENGINES: "imi" (inverted multi-index over projected descriptors),
            "kd" (KD-tree, exact in the projected space) or "hamming" (exhaustive, exact).
        database: What to search in.
        seed: Seed of the vocabulary.
        words_per_query: Cells of the multi-index that are searched per query.
        max_difference: Neighbours that differ by more are not wanted, which saves "imi" time; the others
            may return them.
    """
    if engine == "hamming":
        from maplab_py.vision.hamming_index import HammingIndex

        return HammingIndex(database)
    if engine == "kd":
        from maplab_py.vision.tree_index import TreeIndex

        return TreeIndex(database)
    from maplab_py.vision.multi_index import InvertedMultiIndex

    return InvertedMultiIndex(
        database, seed=seed, cells_per_query=words_per_query, max_distance=max_difference
    )


def compile_kernels(kind: DescriptorKind = _SHORT) -> None:
    """Compile the projection and the search of every index on random tracks.

    Args:
        kind: Descriptors of 8 bytes; bits and numbers have kernels of their own.
    """
    label = np.repeat(np.arange(60), 5)
    descriptors = np.random.default_rng(0).integers(0, 256, (60, 8), dtype=np.uint8)[label]
    database = DescriptorSet(
        projected=learn_projection(descriptors, label, kind=kind, dimensions=4).project(
            descriptors
        ),
        words=kind.comparable(descriptors),
        label=label,
        session=np.zeros(len(label), dtype=np.int32),
        time_ns=np.zeros(len(label), dtype=np.int64),
    )
    for engine in INDEX_ENGINES:
        make_index(engine, database, seed=0, words_per_query=4).nearest(database, 2, MatchRule())
