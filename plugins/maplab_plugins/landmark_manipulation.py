"""Commands on landmarks: triangulate, evaluate, remove, and repair their observations."""

from maplab_py.algorithms.landmarks import options as landmarks
from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, command


@command("retriangulate_landmarks", "rtl", example="rtl --elq_min_observers=2")
def retriangulate_landmarks(
    context: CommandContext,
    *,
    options: landmarks.LandmarkQualityOptions = landmarks.LandmarkQualityOptions(),
    chosen: MissionChoice = ALL_MISSIONS,
) -> landmarks.RetriangulationReport:
    """Triangulate all landmarks from their observations and evaluate their quality."""
    from maplab_py.algorithms.landmarks.triangulation import retriangulate

    return context.apply(retriangulate, options, missions=chosen.rows(context.vi_map))


@command("init_track_landmarks", "itl", example="itl")
def init_track_landmarks(
    context: CommandContext,
    *,
    options: landmarks.LandmarkQualityOptions = landmarks.LandmarkQualityOptions(),
    chosen: MissionChoice = ALL_MISSIONS,
) -> landmarks.TrackReport:
    """Create landmarks for feature tracks that have none, then triangulate all."""
    from maplab_py.algorithms.landmarks.tracks import init_tracks

    return context.apply(init_tracks, options, missions=chosen.rows(context.vi_map))


@command("evaluate_landmark_quality", "elq", example="elq --elq_min_observers=2")
def evaluate_landmark_quality(
    context: CommandContext,
    *,
    options: landmarks.LandmarkQualityOptions = landmarks.LandmarkQualityOptions(),
    chosen: MissionChoice = ALL_MISSIONS,
) -> landmarks.LandmarkQualityReport:
    """Classify every landmark as good or bad."""
    from maplab_py.algorithms.landmarks.quality import evaluate_quality

    return context.apply(evaluate_quality, options, missions=chosen.rows(context.vi_map))


@command("reset_landmark_quality", "rlq", example="rlq")
def reset_landmark_quality(
    context: CommandContext, *, chosen: MissionChoice = ALL_MISSIONS
) -> landmarks.LandmarkQualityReport:
    """Set the quality of all landmarks to unknown."""
    from maplab_py.algorithms.landmarks.quality import reset_quality

    return context.apply(reset_quality, missions=chosen.rows(context.vi_map))


@command("remove_bad_landmarks", "rbl", example="rbl")
def remove_bad_landmarks(
    context: CommandContext, *, chosen: MissionChoice = ALL_MISSIONS
) -> landmarks.LandmarkRemovalReport:
    """Remove all landmarks of quality bad; their keypoints stay."""
    from maplab_py.algorithms.landmarks.removal import remove_bad

    return context.apply(remove_bad, missions=chosen.rows(context.vi_map))


@command("remove_invalid_observations", "rio", example="rio --rio_max_reprojection_error_px=10")
def remove_invalid_observations(
    context: CommandContext,
    *,
    options: landmarks.InvalidObservationOptions = landmarks.InvalidObservationOptions(),
    chosen: MissionChoice = ALL_MISSIONS,
) -> landmarks.InvalidObservationReport:
    """Detach observations that contradict their landmark and create new landmarks from their tracks."""
    from maplab_py.algorithms.landmarks import removal

    return context.apply(
        removal.remove_invalid_observations, options, missions=chosen.rows(context.vi_map)
    )
