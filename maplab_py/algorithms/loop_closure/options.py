"""Options of loop closure."""

from maplab_py.errors import FlagError
from maplab_py.options import Options, option
from maplab_py.vimap.descriptors import FeatureType, type_of_name

_BYTES_OF_DESCRIPTORS = {"": (), "brisk": (48, 64), "freak": (64,), "orb": (32,), "akaze": (61,)}
"""Lengths of binary descriptors: of BRISK, C++ maplab's and OpenCV's."""

MATCHERS = ("nearest", "lighterglue")
_INLIER_FACTORS: dict[int, float] = {FeatureType.XFEAT: 1.25}
"""Its distances let more wrong matches pass. Of recorded pairs with a quarter of the light on one side, the
only wrong pose of 12 or more has 14, the right ones 21 and more."""


class FeatureTypeOptions(Options, prefix="lc_"):
    """The descriptors by which places are recognised."""

    feature_type: str = "Binary"
    """Features that are matched: Binary by different bits, SuperPoint, R2D2, SIFT, LIDARSuperPoint or another
    type by its number by distance; types never match each other"""
    feature_descriptor_type: str = option(
        "", choices=tuple(_BYTES_OF_DESCRIPTORS), flag="feature_descriptor_type"
    )
    """Binary descriptors to match, by their length: brisk (48 or 64 bytes), freak (64), orb (32) or akaze
    (61); empty = those of the most frequent length"""

    def __post_init__(self) -> None:
        super().__post_init__()
        type_of_name(self.feature_type, "lc_feature_type")

    @property
    def type_number(self) -> int:
        """Return the feature type's number."""
        return type_of_name(self.feature_type)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Return the lengths [bytes] that descriptors may have; empty = any."""
        is_binary = self.type_number == FeatureType.BINARY
        return _BYTES_OF_DESCRIPTORS[self.feature_descriptor_type] if is_binary else ()


class LoopClosureOptions(FeatureTypeOptions):
    """Recognition, verification and use of places. maplab's names where it has the option."""

    projection_matrix_filename: str = ""
    """Projection of descriptors that train_projection_matrix wrote; empty, or of another length of
    descriptors = learned from the tracks of the map"""
    target_dimensionality: int = 10
    """Dimensions of a projection that is learned from the map"""
    num_neighbors: int = -1
    """Landmarks to retrieve per keypoint; -1 = 3"""
    max_missions_per_query: int = 8
    """Largest number of other missions that an image is compared with; in larger maps those that most of its
    nearest landmarks belong to"""
    num_words_for_nn_search: int = 16
    """Cells of the multi-index that are searched per keypoint"""
    max_bit_fraction: float = 0.26
    """Largest fraction of descriptor bits in which a match may differ"""
    max_descriptor_distance: float = 0.45
    """Largest Euclidean distance of a match whose descriptors are not binary, scaled to unit length; a third
    more for XFeat"""
    matcher: str = option("nearest", choices=MATCHERS)
    """Matches with a place: of nearest descriptors, or lighterglue: images of candidates with too few inliers
    are matched again by a network (XFeat features only; install_features)"""
    fraction_best_scores: float = 0.25
    """Smallest ratio of the votes of a place to those of the query's best place in the mission"""
    min_image_time_seconds: float = 10.0
    """Vertices of one mission that are closer in time are not matched"""
    min_verify_matches_num: int = 10
    """Smallest number of matches with a place for verification"""
    ransac_pixel_sigma: float = option(2.0, unit="px")
    """Largest reprojection error of an inlier"""
    num_ransac_iters: int = 300
    """Largest number of samples of matches per query vertex"""
    min_inlier_count: int = 12
    """Keypoints that must agree with the pose, a quarter more for XFeat"""
    min_inlier_ratio: float = 0.1
    """Fraction of the query's keypoints matched in the place that must agree"""
    max_gravity_deviation_deg: float = 3.0
    """Largest angle between gravity at the query vertex and in the estimated pose"""
    max_rotation_sigma_deg: float = 1.0
    """Largest standard deviation of the rotation, from the geometry of the inliers"""
    max_delta_position_m: float = -1.0
    """Largest change of the query's position; negative = limited by drift only"""
    max_delta_rotation_deg: float = -1.0
    """Largest change of the query's attitude; negative = not limited"""
    max_drift_ratio: float = 0.1
    """Largest drift of a mission relative to the arc length between query and place; a closure inside a
    mission with a larger correction (plus 0.5 m) is implausible"""
    min_support: int = 2
    """Number of nearby query vertices whose closures must agree in yaw and position"""
    ambiguous_inlier_ratio: float = 0.5
    """A query is ambiguous where another place of the mission has this share of the inliers of the best
    place; above 1 = never"""
    max_neighbour_difference: float = 1.0
    """Largest difference between the poses that nearby closures give, relative to 0.15 m and 1.4 deg plus
    drift; closures with a larger difference contradict each other"""
    max_ambiguous_ratio: float = 0.1
    """Between missions of unknown relative pose: largest ratio of the stretches of a trajectory that only
    another alignment explains to those that only the best one explains; else all closures are rejected"""
    guided_matching: bool = True
    """Search merged landmarks also near the other keypoints of verified query vertices"""
    min_merge_observations: int = 2
    """Number of verified observations that must agree before two landmarks are merged, one more where their
    positions leave doubt; all of them where one of the two has fewer"""
    max_merge_distance_m: float = 0.3
    """Largest distance of merged landmarks once the closure is applied"""
    max_merge_distance_ratio: float = 0.5
    """Largest distance of merged landmarks relative to their distance from the query; the error of landmarks
    is largest in depth, and --lc_max_merge_sigma limits it by the rays"""
    max_merge_sigma: float = 4.0
    """Largest Mahalanobis distance of merged landmarks, from the rays of both landmarks (keypoint error:
    --lc_ransac_pixel_sigma) and the closure's covariance"""
    max_merge_gap_m: float = 0.5
    """Largest correction of a closure that merges landmarks; else relax first"""
    edge_min_distance_meters: float = 0.0
    """Smallest correction of a closure that becomes an edge"""
    edge_covariance_scaler: float = 1.0
    """Factor on the covariance of an edge from verification"""
    switch_variable_variance: float = 1e-2
    """Variance of the prior of an edge's switch variable at 1"""
    only_against_other_missions: bool = False
    """Search places of other missions only"""
    seed: int = 0
    """Seed of all random choices"""

    @property
    def inlier_factor(self) -> float:
        """Required inliers relative to the flag's value."""
        return _INLIER_FACTORS.get(self.type_number, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.matcher == "lighterglue" and self.type_number != FeatureType.XFEAT:
            raise FlagError(
                "--lc_matcher=lighterglue: matches XFeat features: give --lc_feature_type=XFeat, too"
            )
