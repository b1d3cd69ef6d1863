"""Options of the extraction of features and of their tracks."""

import dataclasses

from maplab_py.errors import FlagError
from maplab_py.options import Options, option
from maplab_py.report import Report
from maplab_py.vimap.descriptors import type_of_name
from maplab_py.vision.features.extension import plugin_extractor
from maplab_py.vision.features.extractors import KINDS

PLUGIN = "plugin:"
"""Beginning of the names of extractors that plugins have."""


class ExtractionOptions(Options):
    """Extraction of features from images."""

    feature_type: str = "sift"
    """Detector and descriptor: sift (SIFT, 128 bytes), orb (Binary, 32 bytes), brisk (Binary, 64), akaze
    (Binary, 61), xfeat (XFeat, 64 numbers, a network: install_features), or plugin:NAME, of a plugin"""
    feature_model: str = ""
    """File of a plugin's extractor, such as a network in the ONNX format"""
    max_features: int = option(1000, ge=1, le=100_000)
    """Largest number of keypoints of an image"""
    feature_sigma_px: float = option(0.8, gt=0, le=100)
    """Standard deviation of the new keypoints"""
    replace: bool = False
    """Replace the keypoints of frames that have such features, or keypoints without descriptors, with their
    observations; else those frames stay as they are"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.feature_type not in KINDS and not self.feature_type.startswith(PLUGIN):
            raise FlagError(
                f"--feature_type={self.feature_type}: wants {', '.join(KINDS)} or {PLUGIN}NAME"
            )
        if self.feature_model and not self.feature_type.startswith(PLUGIN):
            raise FlagError(
                f"--feature_model: {self.feature_type} takes no file, only {PLUGIN}NAME"
            )


class FeatureTrackOptions(Options, prefix="track_"):
    """Links between keypoints of neighbouring frames."""

    feature_type: str = option("sift", flag="feature_type")
    """Keypoints to link, by the name of their extractor (sift, orb, brisk, akaze, xfeat, plugin:NAME) or by
    their type (Binary, SuperPoint, R2D2, SIFT, XFeat or a number)"""
    neighbors: int = option(2, ge=1, le=100)
    """Following frames of the camera that a frame is matched with"""
    epipolar_gate_px: float = option(4.0, gt=0)
    """Largest distance of a keypoint from the epipolar line that the map's poses predict"""
    min_depth_m: float = option(0.3, gt=0)
    """Smallest distance of a point, which limits its parallax"""
    max_ratio: float = option(0.9, gt=0, le=1)
    """Largest ratio of the differences of the best and the second best match"""
    max_bit_fraction: float = option(0.25, gt=0)
    """Largest fraction of bits in which matched Binary descriptors differ"""
    max_descriptor_distance: float = option(0.45, gt=0)
    """Largest distance of other matched descriptors, scaled to unit length; a third more for XFeat"""

    def wanted(self) -> tuple[int, tuple[int, ...]]:
        """Return the feature type and the sizes [bytes] of the descriptors, empty = any.

        Raises:
            UserError: There is no such type or plugin.
        """
        if self.feature_type in KINDS:
            kind = KINDS[self.feature_type]
            return kind.feature_type, (kind.size,)
        if self.feature_type.startswith(PLUGIN):
            return plugin_extractor(self.feature_type.removeprefix(PLUGIN)).feature_type, ()
        return type_of_name(self.feature_type, "feature_type"), ()


class ExtractionReport(Report):
    """Features that images gave."""

    feature_type: str
    descriptor_bytes: int
    images: int
    keypoints: int
    median_per_image: float
    frames_that_had_some: int = dataclasses.field(
        default=0, metadata={"title": "frames with such features before"}
    )
    frames_without_image: int = 0
    keypoints_removed: int = 0
    landmarks_removed: int = 0


class FeatureTrackReport(Report):
    """Links of keypoints between frames."""

    feature_type: str
    frame_pairs: int
    matches: int
    median_matches_per_pair: float
    tracks: int
    mean_track_length: float
    contradictions: int  # matches that would put two keypoints of a frame into one track
