"""Options of loop closure."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.options import option


@dataclasses.dataclass(frozen=True)
class LoopClosureOptions:
    """How places are recognised, verified and used. Names are maplab's where it has the option."""

    flag_prefix: ClassVar[str] = "lc_"

    detector_engine: str = option(
        "imi",
        help="Descriptor index: imi (inverted multi-index), kd (KD-tree, exact in the projected "
        "space) or hamming (exhaustive, slow)",
        choices=("imi", "kd", "hamming"),
    )
    projection_matrix_filename: str = option(
        "",
        help="Projection of descriptors that train_projection_matrix wrote; empty, or of another "
        "length of descriptors = learned from the map's own tracks",
    )
    target_dimensionality: int = option(
        10, help="Dimensions of a projection that is learned from the map"
    )
    num_neighbors: int = option(-1, help="Landmarks to retrieve per keypoint; -1 = 3")
    num_words_for_nn_search: int = option(
        16, help="Cells of the multi-index that are searched per keypoint"
    )
    max_bit_fraction: float = option(
        0.26, help="Largest part of a descriptor's bits in which a match may differ"
    )
    fraction_best_scores: float = option(
        0.25, help="A place needs this part of the votes of the query's best place in the mission"
    )
    min_image_time_seconds: float = option(
        10.0, help="Vertices of one mission that are closer in time are not matched", unit="s"
    )
    min_verify_matches_num: int = option(10, help="Matches with one place that are worth verifying")
    ransac_pixel_sigma: float = option(
        2.0, help="Largest reprojection error of an inlier", unit="px"
    )
    num_ransac_iters: int = option(300, help="Most samples of matches per query vertex")
    pose_hypotheses: str = option(
        "gravity",
        help="What a sample makes a pose of: gravity (two matches, and gravity as the query has "
        "it) or three_point (three matches: P3P, generalised for rigs of several cameras)",
        choices=("gravity", "three_point"),
    )
    min_inlier_count: int = option(12, help="Keypoints that must agree with the pose")
    min_inlier_ratio: float = option(
        0.1, help="Part of the query's keypoints matched in the place that must agree"
    )
    max_gravity_deviation_deg: float = option(
        3.0,
        help="Largest angle between gravity as the query vertex has it and as found",
        unit="deg",
    )
    max_rotation_sigma_deg: float = option(
        1.0,
        help="Largest standard deviation of the rotation, by the inliers' own geometry",
        unit="deg",
    )
    max_delta_position_m: float = option(
        -1.0, help="Largest change of the query's position; negative = by drift alone", unit="m"
    )
    max_delta_rotation_deg: float = option(
        -1.0, help="Largest change of the query's attitude; negative = not limited", unit="deg"
    )
    max_drift_ratio: float = option(
        0.1,
        help="Drift that a mission may have, as part of the way between query and place; a closure "
        "inside one mission that corrects more (plus 0.5 m) is implausible",
    )
    min_support: int = option(
        2, help="Other query vertices nearby whose closures must agree in yaw and position"
    )
    max_ambiguous_ratio: float = option(
        0.25,
        help="Between missions of unknown relation: closures that tell another alignment, or whose "
        "query fits several places, as part of those that agree; with more, none of them counts",
    )
    min_merge_observations: int = option(
        2, help="Verified observations that must agree before two landmarks are merged"
    )
    max_merge_distance_m: float = option(
        0.3, help="Largest distance of merged landmarks once the closure is applied", unit="m"
    )
    max_merge_distance_ratio: float = option(
        0.1,
        help="The distance may also be this part of the landmark's distance from the query: depth "
        "is what landmarks err most in",
    )
    max_merge_sigma: float = option(
        4.0,
        help="And at most so many standard deviations, by how the rays of both landmarks cross "
        "(keypoints err by --lc_ransac_pixel_sigma) and by the closure's covariance",
    )
    max_merge_gap_m: float = option(
        0.5,
        help="Landmarks are not merged over a closure that corrects more: relax first",
        unit="m",
    )
    edge_min_distance_meters: float = option(
        0.0, help="Closures that correct less get no edge", unit="m"
    )
    edge_covariance_scaler: float = option(
        1.0, help="Factor on the covariance that verification gives an edge"
    )
    switch_variable_variance: float = option(
        1e-2, help="Variance of the prior that holds an edge's switch variable at 1"
    )
    only_against_other_missions: bool = option(False, help="Look for places of other missions only")
    seed: int = option(0, help="Seed of all random choices")
