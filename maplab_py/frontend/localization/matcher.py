"""Matches of a frame with a map: by the index, or near the places that a pose predicts."""

import dataclasses

import numpy as np

from maplab_py.algorithms.localization.guided import guided_matches
from maplab_py.algorithms.localization.localizer import Localization, Localizer, Outcome
from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.frontend.localization.keypoints import FrameKeypoints
from maplab_py.frontend.localization.map_source import SearchedMap, check_descriptors
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.geometry import se3

_SIGMAS = 3.0
_LEAST_RADIUS_PX, _LARGEST_RADIUS_PX = 6.0, 40.0
"""Search radius around predicted places; beyond the largest the index is asked."""
_NEAREST_M = 1.0
"""Depth at which the search radius is taken before that of a landmark is known."""
_DISTANCE_FACTOR = 1.3
"""Largest distance of descriptors, in multiples of what the index allows."""


@dataclasses.dataclass(frozen=True, eq=False)
class Answer:
    """N keypoints of a frame that observe landmarks of the map, each landmark and keypoint once."""

    time_ns: int
    track_id: I64  # (N,) none is -1
    camera: I32  # (N,)
    landmark: I64  # (N,) rows of the map
    origin_I: F64  # (N, 3)
    ray_I: F64  # (N, 3)
    rad_per_px: F64  # (N,)
    T_G_I: F64 | None  # (7,) by RANSAC; None = too few matches for a pose
    covariance: F64 | None  # (6, 6) of [dp, dtheta]

    def __len__(self) -> int:
        return len(self.track_id)

    def errors_px(self, T_G_I: F64, p_G: F64) -> F64:
        """Return reprojection errors (N,), by angles, at a pose (7,); p_G (L, 3) are the map's."""
        p_I = se3.transform(se3.inverse(T_G_I), p_G[self.landmark])
        return angles_px(p_I, self.origin_I, self.ray_I, self.rad_per_px)


class MapMatcher:
    """Matches frames with an indexed map."""

    def __init__(self, searched: SearchedMap, options: OnlineLocalizationOptions) -> None:
        self._map, self._options = searched, options
        self._matching = dataclasses.replace(
            options.matching,
            max_gravity_misalignment_deg=min(
                options.matching.max_gravity_misalignment_deg, options.max_tilt_deg
            ),
        )
        self._localizer = Localizer(searched.database, self._matching)
        self._has_checked = False

    @property
    def p_G(self) -> F64:
        """Landmarks (L, 3) of the map."""
        return self._map.database.p_G

    def find(self, seen: FrameKeypoints, q_M_I: F64) -> tuple[Answer | None, Outcome]:
        """Ask the index; the attitude (4,) of the body tells gravity.

        Raises:
            UserError: Descriptors have another size than the map's.
        """
        if not len(seen):
            return None, Outcome.FEW_MATCHES
        self._check(seen)
        result = self._localizer.localize(seen.query(q_M_I))
        if result.outcome is not Outcome.LOCALIZED:
            return None, result.outcome
        return self._answer(seen, result), result.outcome

    def track(self, seen: FrameKeypoints, T_G_I: F64, covariance: F64) -> Answer | None:
        """Match landmarks near their places as predicted by a pose with covariance (6, 6).

        Enough matches are verified by a pose that they agree on, few by the prediction.

        Raises:
            UserError: Descriptors have another size than the map's.
        """
        if not len(seen):
            return None
        self._check(seen)
        variance = float(np.trace(covariance[:3, :3])), float(np.trace(covariance[3:, 3:]))
        if not np.isfinite(variance).all():
            return None
        radius_px = self._radius_px(variance, np.full(len(seen), _NEAREST_M), seen.rad_per_px)
        if float(np.median(radius_px)) > _LARGEST_RADIUS_PX:
            return None
        described = self._localizer.described(seen.descriptors)
        keypoint, landmark = guided_matches(
            self._map.database,
            T_G_I,
            projected=described.projected,
            words=described.words,
            origin_I=seen.origin_I,
            ray_I=seen.ray_I,
            radius_rad=radius_px * seen.rad_per_px,
            max_distance=_DISTANCE_FACTOR * self._localizer.max_distance,
        )
        p_I = se3.transform(se3.inverse(T_G_I), self.p_G[landmark])
        rad_per_px = seen.rad_per_px[keypoint]
        error_px = angles_px(p_I, seen.origin_I[keypoint], seen.ray_I[keypoint], rad_per_px)
        depth = np.linalg.norm(p_I, axis=1)
        near = error_px < self._radius_px(variance, depth, rad_per_px)
        keypoint, landmark, error_px = keypoint[near], landmark[near], error_px[near]
        if len(np.unique(landmark)) >= self._matching.min_inlier_count:
            result = self._localizer.verify(seen.query(T_G_I[:4]), keypoint, landmark)
            if result.outcome is Outcome.LOCALIZED:
                return self._answer(seen, result)
        if float(np.median(radius_px)) > 2.0 * _LEAST_RADIUS_PX:
            return None
        chosen = _pairs(keypoint, landmark, error_px)
        return self._of_pairs(seen, keypoint[chosen], landmark[chosen])

    def _check(self, seen: FrameKeypoints) -> None:
        if not self._has_checked:
            check_descriptors(self._map, seen.descriptors.shape[1], seen.feature_type)
            self._has_checked = True

    def _radius_px(self, variance: tuple[float, float], depth_m: F64, rad_per_px: F64) -> F64:
        predicted = np.sqrt(variance[0] / np.maximum(depth_m, 0.3) ** 2 + variance[1]) / rad_per_px
        sigma_px = np.hypot(self._options.keypoint_sigma_px, predicted)
        return np.asarray(np.maximum(_SIGMAS * sigma_px, _LEAST_RADIUS_PX))

    def _answer(self, seen: FrameKeypoints, result: Localization) -> Answer | None:
        p_I = se3.transform(se3.inverse(result.T_G_I), self.p_G[result.landmark])
        k = result.keypoint
        error_px = angles_px(p_I, seen.origin_I[k], seen.ray_I[k], seen.rad_per_px[k])
        chosen = _pairs(k, result.landmark, error_px)
        answer = self._of_pairs(seen, k[chosen], result.landmark[chosen])
        if answer is None or len(answer) < self._options.min_num_constraints:
            return None
        return dataclasses.replace(answer, T_G_I=result.T_G_I, covariance=result.covariance)

    def _of_pairs(self, seen: FrameKeypoints, keypoint: I64, landmark: I64) -> Answer | None:
        tracked = seen.track_id[keypoint] >= 0
        k = keypoint[tracked]
        if not len(k):
            return None
        return Answer(
            seen.time_ns, seen.track_id[k], seen.camera[k], landmark[tracked],
            seen.origin_I[k], seen.ray_I[k], seen.rad_per_px[k], None, None,
        )  # fmt: skip


def angles_px(p_I: F64, origin_I: F64, ray_I: F64, rad_per_px: F64) -> F64:
    """Return the angles (N,) between rays and points (N, 3), in pixels."""
    toward = p_I - origin_I
    (a, b, c), (x, y, z) = ray_I.T, toward.T
    sine = np.sqrt((b * z - c * y) ** 2 + (c * x - a * z) ** 2 + (a * y - b * x) ** 2)
    return np.asarray(np.arctan2(sine, a * x + b * y + c * z) / rad_per_px)


def _pairs(keypoint: I64, landmark: I64, error_px: F64) -> Mask:
    """Choose pairs so that no keypoint and no landmark occurs twice, those of least error first."""
    chosen: Mask = np.zeros(len(keypoint), dtype=np.bool_)
    order = np.lexsort((landmark, keypoint, error_px))
    # the nearest landmark of a keypoint, then the nearest keypoint of a landmark
    _, first = np.unique(keypoint[order], return_index=True)
    order = order[np.sort(first)]
    _, first = np.unique(landmark[order], return_index=True)
    chosen[order[first]] = True
    return chosen
