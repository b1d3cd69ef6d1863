"""Option groups: default, help, unit and range stand once; values out of range name their flag."""

import dataclasses

import pytest

from maplab_py.algorithms.dense.options import DistanceOptions
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.errors import FlagError
from maplab_py.options import Options, help_of, option, unit_of
from maplab_py.server.options import ServiceOptions, SubmapOutput
from maplab_py.storage.cache.options import CacheOptions
from maplab_py.viewer.options import VisualizationOptions


class Base(Options, prefix="base_"):
    """Options."""

    side_m: float = option(0.1, gt=0)
    """Side of a
    voxel."""
    drift_deg: float = option(0.4, ge=0, le=1, unit="deg/sqrt(s)", flag="drift")
    """Drift."""
    name: str = "a"


class Derived(Base):
    """More of them."""

    count: int = option(3, help="Number")


def test_help_and_unit_follow_the_declaration() -> None:
    fields = dataclasses.fields(Derived)
    assert [help_of(Derived, field) for field in fields] == [
        "Side of a voxel.",
        "Drift.",
        "",
        "Number",
    ]
    assert [unit_of(field) for field in fields] == ["m", "deg/sqrt(s)", "", ""]
    assert Derived.flag_prefix == "base_"


@pytest.mark.parametrize(
    ("options", "name", "value", "said"),
    [
        (Derived, "side_m", 0.0, "--base_side_m=0: must be above 0"),
        (Derived, "side_m", float("nan"), "--base_side_m=nan: must be above 0"),
        (Derived, "side_m", float("inf"), "--base_side_m=inf: must be above 0 and finite"),
        (Derived, "drift_deg", 2.0, "--drift=2: must be at least 0 and at most 1"),
        (CacheOptions, "map_cache_max_gb", 0.0, "--map_cache_max_gb=0: must be above 0"),
        (DistanceOptions, "max_distance_m", 0.0, "_max_distance_m=0: must be above 0"),
        (DistanceOptions, "clear_sphere_inner_radius", 2.0, "inner_radius"),
        (KeyframingOptions, "every_nth_vertex", 0, "--kf_every_nth_vertex=0"),
        (KeyframingOptions, "distance_threshold_m", -1.0, "--kf_distance_threshold_m=-1"),
        (LandmarkQualityOptions, "min_observers", -1, "--elq_min_observers=-1"),
        (LandmarkQualityOptions, "min_observation_angle_deg", 200.0, "_angle_deg=200"),
        (LandmarkQualityOptions, "min_distance_from_closest_observer", 50.0, "closest_observer"),
        (SelfCalibrationOptions, "segments_per_group", 0, "--sc_segments_per_group=0"),
        (SelfCalibrationOptions, "segment_keyframes", 1, "--sc_segment_keyframes=1"),
        (SelfCalibrationOptions, "prior_position_m", 0.0, "--sc_prior_position_m=0"),
        (ServiceOptions, "stop_when_idle_s", -1.0, "--serve_stop_when_idle_s=-1: must be at least"),
        (ServiceOptions, "visualization_interval_s", -1.0, "--serve_visualization_interval_s=-1"),
        (SubmapOutput, "submap_interval_s", 0.0, "submap_interval_s=0"),
        (VIOptimizationOptions, "max_observations_per_landmark", -1, "--ba_max_observations"),
        (VIOptimizationOptions, "max_observations_per_landmark", 1, "--ba_max_observations"),
        (VIOptimizationOptions, "max_covisible_frames", -3, "--ba_max_covisible_frames=-3"),
        (VisualizationOptions, "max_points", 0, "--vis_max_points=0"),
        (VisualizationOptions, "scale", 0.0, "--vis_scale=0"),
        (VisualizationOptions, "landmark_gray_level", 300, "--vis_landmark_gray_level=300"),
        (VisualizationOptions, "max_refused_closures", -1, "--vis_max_refused_closures=-1"),
        (VisualizationOptions, "refused_closures_reason", "weather", "--vis_refused_closures"),
    ],
)
def test_values_out_of_range_name_their_flag(
    options: type[Options], name: str, value: object, said: str
) -> None:
    with pytest.raises(FlagError) as caught:
        options(**{name: value})
    assert said in str(caught.value)


def test_options_are_frozen_values() -> None:
    options = Derived(side_m=1.0)
    assert options == Derived(side_m=1.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        options.side_m = 2.0  # type: ignore[misc]
