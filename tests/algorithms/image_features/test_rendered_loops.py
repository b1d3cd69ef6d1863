"""Loop closure by SIFT against BRISK, both of the same rendered images of two sessions."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.image_features import extraction, tracks
from maplab_py.algorithms.image_features.options import ExtractionOptions, FeatureTrackOptions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.tracks import init_tracks
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import search_loops
from maplab_py.interop.resources.images import import_images
from maplab_py.simulation.raw_data import write_maps
from maplab_py.simulation.scenario import SessionImages
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.truth import Truth
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap, merge, table
from tests.algorithms.loop_closure.against_truth import is_right

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> tuple[VIMap, Truth]:
    """Two walks of 14 s at 3 Hz, the second in less light and from another height."""
    folder = tmp_path_factory.mktemp("loops")
    scenario = load_scenario("stereo_room").with_seed(2)
    first = dataclasses.replace(scenario.sessions[0], duration_s=14.0, turns=0.6)
    darker = SessionImages(light=0.7)
    second = dataclasses.replace(first, start_turn=0.25, height_m=1.6, images=darker)
    scenario = dataclasses.replace(
        scenario,
        cameras=scenario.cameras[:1],
        measurement=dataclasses.replace(scenario.measurement, frame_rate_hz=3.0),
        sessions=(first, second),
    )
    write_maps(scenario, folder, raw_data=True)
    maps = [
        import_images(load_map(folder / name)[0], 0, folder / "raw" / name)[0]
        for name in ("session_1", "session_2")
    ]
    return without_features(merge.merge_maps(*maps)[0]), Truth.load(folder / "truth.npz")


def without_features(vi_map: VIMap) -> VIMap:
    """Return the map without the keypoints that the simulator made."""
    frames = vi_map.frames
    return vi_map.replace(
        frames=frames.replace(
            keypoint_count=np.zeros(len(frames), dtype=np.int32),
            descriptor_blocks=table.object_column([None] * len(frames)),
        ),
        keypoints=vi_map.keypoints.take(np.zeros(0, dtype=np.int64)),
        landmarks=vi_map.landmarks.take(np.zeros(0, dtype=np.int64)),
    )


def closed(vi_map: VIMap, truth: Truth, name: str, feature_type: str) -> tuple[int, int]:
    """Return how many vertices have a right closure, and how many accepted closures are wrong."""
    described, _ = extraction.extract_features(
        vi_map, Path(), ExtractionOptions(feature_type=name, max_features=400)
    )
    tracked, _ = tracks.track_features(described, FeatureTrackOptions(feature_type=name))
    mapped, _ = init_tracks(tracked, LandmarkQualityOptions())
    search, _ = search_loops(mapped, LoopClosureOptions(feature_type=feature_type))
    closures = search.closures
    right = closures.accepted & is_right(mapped, truth, closures)
    wrong = int(np.count_nonzero(closures.accepted & ~right))
    return len(np.unique(closures.query_vertex[right])), wrong


def test_sift_closes_at_least_the_loops_of_brisk(sessions: tuple[VIMap, Truth]) -> None:
    by_sift = closed(*sessions, "sift", "SIFT")
    by_brisk = closed(*sessions, "brisk", "Binary")
    assert by_sift[1] == by_brisk[1] == 0
    assert by_brisk[0] > 20
    assert by_sift[0] >= by_brisk[0]
