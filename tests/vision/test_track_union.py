import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from maplab_py.vision.track_union import unite_tracks


def unite(pairs, images):
    start = np.cumsum([0, *map(len, images)])
    flat = np.array([i for one in images for i in one], dtype=np.int64)
    first, second = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    return unite_tracks(first.copy(), second.copy(), start, flat, 20).tolist()


def test_tracks_seen_in_one_image_stay_apart():
    assert unite([(0, 1)], [[0, 1], [1, 2]]) == [False]
    assert unite([(0, 1)], [[0, 1], [2, 3]]) == [True]


def test_what_was_united_before_counts():
    assert unite([(0, 1), (1, 2)], [[0], [1], [0]]) == [True, False]
    assert unite([(0, 1), (1, 0)], [[0], [1]]) == [True, True]


@settings(deadline=None)
@given(
    images=st.lists(st.sets(st.integers(0, 19), max_size=5), min_size=2, max_size=12),
    data=st.data(),
)
def test_no_united_track_holds_an_image_twice(images, data):
    track = st.integers(0, len(images) - 1)
    pairs = data.draw(st.lists(st.tuples(track, track), min_size=1, max_size=30))
    accepted = unite(pairs, [sorted(one) for one in images])
    group = list(range(len(images)))
    for (a, b), ok in zip(pairs, accepted, strict=True):
        if ok:
            old, new = group[b], group[a]
            group = [new if g == old else g for g in group]
    for g in set(group):
        seen = [i for track, one in enumerate(images) if group[track] == g for i in one]
        assert len(seen) == len(set(seen))
