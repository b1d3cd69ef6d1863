"""Candidates with too few inliers are matched again by a network, here one that knows the answer."""

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.second_matching import check_matcher
from maplab_py.algorithms.loop_closure.workflow import search_loops
from maplab_py.array_types import I64
from maplab_py.errors import FlagError, UserError
from maplab_py.vimap.descriptors import DescriptorDepth, FeatureType
from maplab_py.vision.descriptors import DescriptorKind
from maplab_py.vision.features.learned.lighterglue import ImageKeypoints
from tests.algorithms.loop_closure.rooms import Walk, make_map
from tests.support.float_features import with_numbers

STRICT = LoopClosureOptions(
    feature_type="XFeat", max_descriptor_distance=0.55, min_inlier_count=92, min_support=1
)
AGAIN = LoopClosureOptions(
    feature_type="XFeat", max_descriptor_distance=0.55, min_inlier_count=92, min_support=1,
    matcher="lighterglue",
)  # fmt: skip


class MostSimilar:
    """A matcher of all keypoints that are mutually most similar, however different they are."""

    def __init__(self) -> None:
        self.pairs = 0

    def match(self, pairs: list[tuple[ImageKeypoints, ImageKeypoints]]) -> list[tuple[I64, I64]]:
        self.pairs += len(pairs)
        assert all(image.size_px == (640, 480) for pair in pairs for image in pair)
        result = []
        for a, b in pairs:
            product = a.descriptors @ b.descriptors.T
            best = np.argmax(product, axis=1)
            i = np.flatnonzero(np.argmax(product, axis=0)[best] == np.arange(len(best)))
            result.append((i, best[i]))
        return result


def test_weak_candidates_are_matched_again(monkeypatch: pytest.MonkeyPatch) -> None:
    vi_map, _ = make_map(
        [Walk(room=1), Walk(room=1, mission=1), Walk(room=2, mission=2)], flips=0.1
    )
    vi_map = with_numbers(vi_map, FeatureType.XFEAT)
    network = MostSimilar()
    monkeypatch.setattr(
        "maplab_py.algorithms.loop_closure.second_matching.installed_lighterglue", lambda: network
    )
    nearest, report = search_loops(vi_map, STRICT)
    again, report_again = search_loops(vi_map, AGAIN)
    few, many = nearest.closures, again.closures
    assert len(few) == len(many) > 0
    assert np.array_equal(few.query_vertex, many.query_vertex)
    weak = few.inliers < 1.25 * STRICT.min_inlier_count
    assert network.pairs == np.count_nonzero(weak) > 0
    assert (many.inliers >= few.inliers).all()
    assert np.array_equal(many.inliers[~weak], few.inliers[~weak])
    assert np.count_nonzero(many.accepted) > np.count_nonzero(few.accepted)
    mission = vi_map.vertices.mission
    assert (mission[many.query_vertex[many.accepted]] < 2).all()
    assert np.array_equal(many.start, np.append(0, np.cumsum(many.inliers)))
    assert not [note for note in report.notes if "LighterGlue" in note]
    (note,) = (note for note in report_again.notes if "LighterGlue" in note)
    assert f"matched {np.count_nonzero(weak)} candidates again" in note


def test_without_the_network_or_with_other_features_it_is_said(
    tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(FlagError, match="--lc_matcher=lighterglue: matches XFeat features"):
        LoopClosureOptions(matcher="lighterglue")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    vi_map = with_numbers(make_map([Walk(room=1), Walk(room=1, mission=1)])[0], FeatureType.XFEAT)
    options = LoopClosureOptions(feature_type="XFeat", matcher="lighterglue", min_inlier_count=1)
    with pytest.raises(UserError, match="LighterGlue is not installed on this computer"):
        search_loops(vi_map, options)  # though no candidate would be matched again
    with pytest.raises(UserError, match=r"of 256 bytes, the map has XFeat of 64 bytes: give --lc"):
        check_matcher(DescriptorKind(64, FeatureType.XFEAT, DescriptorDepth.UINT8))
