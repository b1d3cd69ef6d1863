"""Localisation in rendered rooms under other light, by features: `python -m benchmarks.learned_rooms FOLDER`.

The map is made by day. One session of queries crosses the room in a quarter of the light, another one is near
the walls in an eighth of it, with gains that jump and more surfaces that are repainted. For XFeat, closures
between the sessions are counted, too, by nearest descriptors and by LighterGlue.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.algorithms.image_features import extraction, tracks
from maplab_py.algorithms.image_features.options import ExtractionOptions, FeatureTrackOptions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.tracks import init_tracks
from maplab_py.algorithms.localization.database import (
    LocalizationMap,
    database_of_map,
    database_of_summary,
)
from maplab_py.algorithms.localization.localization import localize_missions
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.algorithms.loop_closure.options import MATCHERS, LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import search_loops
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.geometry import se3, so3
from maplab_py.interop.resources.images import import_images
from maplab_py.simulation import raw_data, scenario_file
from maplab_py.simulation.scenario import Scenario, SessionImages
from maplab_py.simulation.truth import Truth, true_map
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap, table
from maplab_py.vimap.merge import merge_maps
from maplab_py.vision.features.extractors import KINDS

_DUSK = SessionImages(light=0.25, gain_jump=0.3, gain_jump_every_s=2.0, repainted_share=0.3)
_NIGHT = SessionImages(light=0.12, gain_jump=0.5, gain_jump_every_s=1.0, repainted_share=0.4)
_RIGHT_M, _RIGHT_DEG, _WRONG_M, _WRONG_DEG = 0.25, 2.0, 0.5, 5.0


def _without_features(vi_map: VIMap) -> VIMap:
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


def _scenario() -> Scenario:
    scenario = scenario_file.load_scenario("stereo_room").with_seed(2)
    day = dataclasses.replace(scenario.sessions[0], duration_s=14.0, turns=1.0)
    query = dataclasses.replace(day, duration_s=8.0, turns=0.6, start_turn=0.25)
    dusk = dataclasses.replace(
        query, kind="figure_8", height_m=2.0, wall_distance_m=1.5, look_around_rad=0.7, images=_DUSK
    )
    night = dataclasses.replace(
        query, height_m=2.4, wall_distance_m=0.8, look_around_rad=1.0, images=_NIGHT
    )
    return dataclasses.replace(
        scenario,
        cameras=scenario.cameras[:1],
        measurement=dataclasses.replace(scenario.measurement, frame_rate_hz=3.0),
        sessions=(day, dusk, night),
    )


def _described(vi_map: VIMap, features: str) -> VIMap:
    options = ExtractionOptions(feature_type=features, max_features=600)
    return extraction.extract_features(vi_map, Path(), options)[0]


def _count(database: LocalizationMap, queries: VIMap) -> str:
    """Return right, wrong and all queries in words; their poses are true."""
    if not len(queries.keypoints):
        return "no keypoint"
    result = localize_missions(database, queries, LocalizationOptions())
    error = se3.relative(queries.T_G_I[result.vertex], result.T_G_I)
    distance = np.linalg.norm(error[:, 4:], axis=1)
    turn = np.degrees(np.linalg.norm(so3.log(error[:, :4]), axis=1))
    right = result.is_localized & (distance < _RIGHT_M) & (turn < _RIGHT_DEG)
    wrong = result.is_localized & ((distance > _WRONG_M) | (turn > _WRONG_DEG))
    return f"{np.count_nonzero(right)} right, {np.count_nonzero(wrong)} wrong of {len(right)}"


def _mapped(session: VIMap, features: str) -> VIMap:
    tracked, _ = tracks.track_features(session, FeatureTrackOptions(feature_type=features))
    return init_tracks(tracked, LandmarkQualityOptions())[0]


def _closures(day: VIMap, query: VIMap, matcher: str) -> str:
    """Return right and wrong accepted closures between two sessions in words; their poses are true."""
    vi_map = merge_maps(day, _mapped(query, "xfeat"))[0]
    options = LoopClosureOptions(feature_type="XFeat", matcher=matcher)
    found = search_loops(vi_map, options)[0].closures
    mission = vi_map.vertices.mission
    a, b = found.query_vertex, found.place_vertex
    counts = found.accepted & (mission[a] != mission[b])
    T_G_I = se3.compose(vi_map.T_G_M[mission[b]], found.T_M_I)
    distance = np.linalg.norm(vi_map.T_G_I[a, 4:] - T_G_I[:, 4:], axis=1)
    right, wrong = counts & (distance < _RIGHT_M), counts & (distance > _WRONG_M)
    return f"{np.count_nonzero(right)} right, {np.count_nonzero(wrong)} wrong"


def main() -> None:
    """Render the sessions unless the folder has them, and print a line for each kind of map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    if not folder.exists():
        raw_data.write_maps(_scenario(), folder, raw_data=True)
    truth = Truth.load(folder / "truth.npz")
    sessions = []
    for name in ("session_1", "session_2", "session_3"):
        vi_map, _ = import_images(load_map(folder / name)[0], 0, folder / "raw" / name)
        sessions.append(_without_features(true_map(vi_map, truth)))
    for features in ("xfeat", "sift", "brisk", "orb"):
        day, dusk, night = (_described(session, features) for session in sessions)
        vi_map = _mapped(day, features)
        feature_type = KINDS[features].feature_type
        summary = make_summary_map(vi_map, SummaryMapOptions(), feature_type=feature_type)
        databases = {
            "full": database_of_map(vi_map, feature_type=feature_type),
            "summary": database_of_summary(summary),
        }
        for kind, database in databases.items():
            print(
                f"{features:6} {kind:8} dusk: {_count(database, dusk):28} night: {_count(database, night)}",
                flush=True,
            )
        for matcher in MATCHERS if features == "xfeat" else ():
            by_session = [_closures(vi_map, query, matcher) for query in (dusk, night)]
            print(
                f"closures by {matcher:11} dusk: {by_session[0]:20} night: {by_session[1]}",
                flush=True,
            )


if __name__ == "__main__":
    main()
