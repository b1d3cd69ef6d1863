"""Reports of the extraction and the tracks of features."""

from __future__ import annotations

import dataclasses

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
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


@dataclasses.dataclass(frozen=True)
class FeatureTrackReport(Report):
    """Links of keypoints between frames."""

    feature_type: str
    frame_pairs: int
    matches: int
    median_matches_per_pair: float
    tracks: int
    mean_track_length: float
    contradictions: int  # matches that would put two keypoints of a frame into one track
