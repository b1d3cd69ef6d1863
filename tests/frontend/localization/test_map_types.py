"""Maps whose descriptors are not those of recordings."""

from __future__ import annotations

import pytest

from maplab_py.algorithms.landmarks.quality import evaluate_unknown_quality
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.errors import UserError
from maplab_py.frontend.localization.map_source import check_descriptors, of_map, of_summary
from maplab_py.vimap.descriptors import FeatureType
from tests.algorithms.loop_closure.rooms import Walk, make_map
from tests.support.float_features import with_numbers


def test_maps_without_binary_descriptors_are_refused_by_their_types() -> None:
    vi_map, _ = evaluate_unknown_quality(make_map([Walk(room=1, vertices=12)])[0])
    numbers = with_numbers(vi_map, FeatureType.R2D2)
    message = "office: its descriptors are R2D2, those of the recording Binary: choose"
    with pytest.raises(UserError, match=message):
        of_map(numbers, "office")
    summary = make_summary_map(numbers, SummaryMapOptions(), feature_type=FeatureType.R2D2)
    with pytest.raises(UserError, match=message):
        check_descriptors(of_summary(summary, "office"), 48, FeatureType.BINARY)
    check_descriptors(of_map(vi_map, "office"), 48, FeatureType.BINARY)
    learned = with_numbers(vi_map, FeatureType.XFEAT)
    with pytest.raises(UserError, match="or give --feature_tracking_descriptor_type=xfeat"):
        of_map(learned, "office")
    kind = of_map(learned, "office", feature_type=FeatureType.XFEAT).database.projection.kind
    assert kind.feature_type == FeatureType.XFEAT
    with pytest.raises(
        UserError, match=r"those of the recording XFeat: choose .*descriptor_type=brisk"
    ):
        of_map(vi_map, "office", feature_type=FeatureType.XFEAT)
    with pytest.raises(UserError, match="its descriptors have 48 bytes, those of the recording 64"):
        check_descriptors(of_map(vi_map, "office"), 64, FeatureType.BINARY)
