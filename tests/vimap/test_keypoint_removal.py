from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.descriptors import DescriptorBlock
from maplab_py.vimap.keypoint_removal import remove_keypoints
from maplab_py.vimap.table import object_column
from tests.algorithms.loop_closure.rooms import Walk, make_map

EDGES = "vertex without an edge to the next of its mission"


def two_types():  # type: ignore[no-untyped-def]
    """Return a map whose frames have a Binary and a SIFT block each."""
    vi_map, _ = make_map([Walk(room=1, vertices=5)])
    rng = np.random.default_rng(0)
    descriptor = rng.integers(1, 200, (len(vi_map.keypoints), 128), dtype=np.uint8)
    blocks = [
        (DescriptorBlock(count // 3, 48), DescriptorBlock(count - count // 3, 128, 0, 3))
        for count in vi_map.frames.keypoint_count.tolist()
    ]
    return vi_map.replace(
        frames=vi_map.frames.replace(descriptor_blocks=object_column(blocks)),
        keypoints=vi_map.keypoints.replace(descriptor=descriptor),
    )


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0))
def test_the_kept_keypoints_keep_what_they_have(seed: int, share: float) -> None:
    vi_map = two_types()
    removed = np.random.default_rng(seed).random(len(vi_map.keypoints)) < share
    result = remove_keypoints(vi_map, removed)
    errors = check_consistency(result).errors
    assert {error.rule for error in errors} <= {EDGES}  # which the map of rooms has none of
    np.testing.assert_array_equal(result.feature_type, vi_map.feature_type[~removed])
    np.testing.assert_array_equal(result.keypoint_frame, vi_map.keypoint_frame[~removed])
    np.testing.assert_array_equal(
        result.keypoints.descriptor, vi_map.keypoints.descriptor[~removed]
    )
    left = vi_map.keypoints.landmark[~removed]
    observed = np.unique(left[left >= 0])
    np.testing.assert_array_equal(result.landmarks.id, vi_map.landmarks.id[observed])


def test_nothing_removed_is_the_same_map() -> None:
    vi_map = two_types()
    assert remove_keypoints(vi_map, np.zeros(len(vi_map.keypoints), dtype=np.bool_)) is vi_map
    none = remove_keypoints(vi_map, np.ones(len(vi_map.keypoints), dtype=np.bool_))
    assert len(none.keypoints) == len(none.landmarks) == 0
    assert set(none.frames.descriptor_blocks.tolist()) == {()}
