"""Commands that compute features from images and link them into tracks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.algorithms.image_features.options import ExtractionOptions, FeatureTrackOptions
from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, command

if TYPE_CHECKING:
    from maplab_py.algorithms.image_features.options import ExtractionReport, FeatureTrackReport


@command(
    "extract_features",
    example="extract_features --feature_type=sift --max_features=1000",
    see_also=("import_images", "track_features", "loopclosure_all_missions"),
)
def extract_features(
    context: CommandContext,
    *,
    options: ExtractionOptions = ExtractionOptions(),
    chosen: MissionChoice = ALL_MISSIONS,
) -> ExtractionReport:
    """Compute keypoints and descriptors from the images that the map has as resources.

    They are added to the keypoints that the frames have. `track_features` links them between frames,
    `init_track_landmarks` then makes landmarks.
    """
    from maplab_py.algorithms.image_features.extraction import extract_features as extract

    return context.apply(
        extract,
        context.map_folder or Path(),
        options,
        missions=chosen.rows(context.vi_map),
        progress=context.progress,
    )


@command(
    "track_features",
    example="track_features --feature_type=sift",
    see_also=("extract_features", "init_track_landmarks"),
)
def track_features(
    context: CommandContext,
    *,
    options: FeatureTrackOptions = FeatureTrackOptions(),
    chosen: MissionChoice = ALL_MISSIONS,
) -> FeatureTrackReport:
    """Link keypoints without track between neighbouring frames, on epipolar lines of the map's poses.

    `init_track_landmarks` then makes landmarks of the tracks.
    """
    from maplab_py.algorithms.image_features.tracks import track_features as track

    return context.apply(
        track, options, missions=chosen.rows(context.vi_map), progress=context.progress
    )
