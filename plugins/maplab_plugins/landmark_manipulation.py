"""Commands on landmarks: triangulate, judge, remove, and repair their observations."""

from __future__ import annotations

from maplab_py.algorithms.landmarks.options import (
    InvalidObservationOptions,
    LandmarkQualityOptions,
)
from maplab_py.algorithms.landmarks.reports import (
    InvalidObservationReport,
    LandmarkQualityReport,
    RemovalReport,
    RetriangulationReport,
    TrackReport,
)
from maplab_py.plugin import CommandContext, command

_QUALITY = LandmarkQualityOptions()
_INVALID = InvalidObservationOptions()


@command("retriangulate_landmarks", "rtl", example="rtl --elq_min_observers=2")
def retriangulate_landmarks(
    context: CommandContext,
    *,
    options: LandmarkQualityOptions = _QUALITY,
    map_mission: str = "",
    map_mission_list: str = "",
) -> RetriangulationReport:
    """Triangulate all landmarks from their observations and evaluate their quality.

    Args:
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
    """
    from maplab_py.algorithms.landmarks.triangulation import retriangulate

    missions = context.mission_rows(map_mission, map_mission_list)
    result, report = retriangulate(
        context.vi_map, options, missions=missions, progress=context.progress
    )
    context.commit(result)
    return report


@command("init_track_landmarks", "itl", example="itl")
def init_track_landmarks(
    context: CommandContext,
    *,
    options: LandmarkQualityOptions = _QUALITY,
    map_mission: str = "",
    map_mission_list: str = "",
) -> TrackReport:
    """Make landmarks from feature tracks that have none, then triangulate all.

    Args:
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
    """
    from maplab_py.algorithms.landmarks.tracks import init_tracks

    missions = context.mission_rows(map_mission, map_mission_list)
    result, report = init_tracks(
        context.vi_map, options, missions=missions, progress=context.progress
    )
    context.commit(result)
    return report


@command("evaluate_landmark_quality", "elq", example="elq --elq_min_observers=2")
def evaluate_landmark_quality(
    context: CommandContext,
    *,
    options: LandmarkQualityOptions = _QUALITY,
    map_mission: str = "",
    map_mission_list: str = "",
) -> LandmarkQualityReport:
    """Judge every landmark: good or bad.

    Args:
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
    """
    from maplab_py.algorithms.landmarks.quality import evaluate_quality

    missions = context.mission_rows(map_mission, map_mission_list)
    result, report = evaluate_quality(
        context.vi_map, options, missions=missions, progress=context.progress
    )
    context.commit(result)
    return report


@command("reset_landmark_quality", "rlq", example="rlq")
def reset_landmark_quality(
    context: CommandContext, *, map_mission: str = "", map_mission_list: str = ""
) -> LandmarkQualityReport:
    """Set the quality of all landmarks to unknown.

    Args:
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
    """
    from maplab_py.algorithms.landmarks.quality import reset_quality

    missions = context.mission_rows(map_mission, map_mission_list)
    result, report = reset_quality(context.vi_map, missions=missions, progress=context.progress)
    context.commit(result)
    return report


@command("remove_bad_landmarks", "rbl", example="rbl")
def remove_bad_landmarks(
    context: CommandContext, *, map_mission: str = "", map_mission_list: str = ""
) -> RemovalReport:
    """Remove all landmarks of quality bad; their keypoints stay.

    Args:
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
    """
    from maplab_py.algorithms.landmarks.removal import remove_bad

    missions = context.mission_rows(map_mission, map_mission_list)
    result, report = remove_bad(context.vi_map, missions=missions, progress=context.progress)
    context.commit(result)
    return report


@command("remove_invalid_observations", "rio", example="rio --rio_max_reprojection_error_px=10")
def remove_invalid_observations(
    context: CommandContext,
    *,
    options: InvalidObservationOptions = _INVALID,
    map_mission: str = "",
    map_mission_list: str = "",
) -> InvalidObservationReport:
    """Detach observations that contradict their landmark and make new landmarks from their tracks.

    Args:
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
    """
    from maplab_py.algorithms.landmarks import removal

    missions = context.mission_rows(map_mission, map_mission_list)
    result, report = removal.remove_invalid_observations(
        context.vi_map, options, missions=missions, progress=context.progress
    )
    context.commit(result)
    return report
