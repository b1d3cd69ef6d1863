"""Maps whose descriptors are not those of recordings."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.quality import evaluate_unknown_quality
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.errors import UserError
from maplab_py.frontend.localization.map_source import check_descriptors, of_map, of_summary
from maplab_py.frontend.localization.online import opened_localization
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.storage.native import save_map
from maplab_py.storage.summary_map import write_summary_map
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
    with pytest.raises(UserError, match="or give --vio_localization_features=xfeat"):
        of_map(learned, "office")
    kind = of_map(learned, "office", feature_type=FeatureType.XFEAT).database.projection.kind
    assert kind.feature_type == FeatureType.XFEAT
    with pytest.raises(UserError, match=r"those of the recording XFeat: choose .*features=brisk"):
        of_map(vi_map, "office", feature_type=FeatureType.XFEAT)
    with pytest.raises(UserError, match="its descriptors have 48 bytes, those of the recording 64"):
        check_descriptors(of_map(vi_map, "office"), 64, FeatureType.BINARY)


def test_images_get_the_descriptors_that_the_map_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "maplab_py.frontend.localization.online.check_descriptors_exist", lambda name: None
    )
    vi_map, _ = evaluate_unknown_quality(make_map([Walk(room=1, vertices=12)])[0])
    learned = with_numbers(vi_map, FeatureType.XFEAT)
    save_map(learned, tmp_path / "map")
    summary = make_summary_map(learned, SummaryMapOptions(), feature_type=FeatureType.XFEAT)
    write_summary_map(summary, tmp_path / "summary")
    device = MapRecording(vi_map, 0).device
    for folder in ("map", "summary"):
        options = OnlineLocalizationOptions(map_folder=tmp_path / folder)
        localization = opened_localization(options, device, OdometryOptions())
        assert localization is not None
        assert localization.features == "xfeat"
        options = dataclasses.replace(options, features="brisk")
        with pytest.raises(UserError, match=r"of the recording Binary: .*features=xfeat"):
            opened_localization(options, device, OdometryOptions())
    assert summary.descriptors.shape[1] == 24
    assert np.abs(summary.descriptors * 4.0).max() < 128
    assert np.array_equal(summary.descriptors * 4.0, np.rint(summary.descriptors * 4.0))
