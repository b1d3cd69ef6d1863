"""The fixed-lag smoother, localised in a map: T_G_M is one more state (VIL).

Source: Schneider 2019, Paper I, sections 3.2 and 3.3. T_G_M has six numbers, a prior on its tilt because
both frames are level, and a place in the marginal prior, like the states of the frames.
"""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.errors import EstimationError
from maplab_py.estimation.kernels.window_arguments import FRAME_SIZE
from maplab_py.estimation.window import map_tracks, smoother
from maplab_py.estimation.window.calibration import WindowCalibration
from maplab_py.estimation.window.map_terms import MAP_GATE_CHI2, MapTerms, contradicted_unless_most
from maplab_py.estimation.window.options import MapRule, WindowOptions
from maplab_py.estimation.window.problem import WindowProblem
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, Imu

_LANDMARK_CHI2 = 16.3
"""Squared distance of a landmark from the map's, in standard deviations (99.9 % of 3 dimensions)."""


@dataclasses.dataclass(frozen=True, eq=False)
class MapPose:
    """Pose of the newest frame in the map."""

    T_G_M: F64  # (7,)
    T_G_I: F64  # (7,)
    covariance: F64  # (6, 6) of [dp, dtheta] of T_G_I; infinite where it is not determined


class LocalizedSmoother(smoother.FixedLagSmoother):
    """A fixed-lag smoother that estimates T_G_M, too, from when it is given one.

    Until then it does what `FixedLagSmoother` does, bit by bit.
    """

    def __init__(
        self,
        cameras: tuple[Camera, ...],
        T_I_C: F64,
        imu: Imu,
        options: WindowOptions,
        rule: MapRule | None = None,
        calibration: WindowCalibration | None = None,
    ) -> None:
        """Prepare as `FixedLagSmoother` does."""
        super().__init__(cameras, T_I_C, imu, options, calibration)
        self.rule = rule or MapRule()
        self.map_tracks = map_tracks.MapTracks(estimates_landmarks=self.rule.estimates_landmarks)
        self._used: I64 = np.zeros(0, dtype=np.int64)  # associations of the latest terms
        self._map_rows = self._used  # of these, whose landmarks are states
        self._latest_terms: MapTerms | None = None
        self._checked_terms: MapTerms | None = None  # of the update that has begun
        self._pose: MapPose | None = None

    @property
    def is_localized(self) -> bool:
        """Whether T_G_M is a state."""
        return len(self._states.T_G_M) > 0

    @property
    def map_pose(self) -> MapPose | None:
        """Pose after the last update; None while T_G_M is not a state."""
        return self._pose if self.is_localized else None

    @property
    def map_terms(self) -> MapTerms | None:
        """The latest observations of the map that were evaluated; None before the first."""
        return self._latest_terms

    def start_base_frame(self, T_G_M: F64) -> None:
        """Make T_G_M (7,) a state, linearised there; information on an earlier one is removed.

        Raises:
            EstimationError: The smoother has not been started.
        """
        if not len(self._states):
            raise EstimationError("the smoother has not been started: call start() first")
        rule = self.rule
        sigma = np.repeat([rule.base_sigma_m, rule.base_sigma_rad], 3)
        self.map_tracks.clear()
        self._prior = self._prior.with_base(T_G_M, sigma)
        none = np.zeros((0, 3))
        self._states = dataclasses.replace(self._states, T_G_M=T_G_M[None], p_G=none)
        self._pose = None

    def stop_base_frame(self) -> None:
        """Go on without the map."""
        self.map_tracks.clear()
        self._prior = self._prior.without_base()
        none = np.zeros((0, 3))
        self._states = dataclasses.replace(self._states, T_G_M=np.zeros((0, 7)), p_G=none)
        self._pose = None

    def associate(self, matches: map_tracks.MapMatches) -> int:
        """Associate whole tracks with landmarks of the map from the next update on; return their number.

        A track stops being a landmark of the odometry: none of its keypoints enters twice.

        Raises:
            EstimationError: T_G_M is no state.
        """
        if not self.is_localized:
            raise EstimationError("there is no base frame: call start_base_frame() first")
        added = self.map_tracks.add(matches, self.tracks)
        self.tracks.is_landmark &= ~self.map_tracks.includes(self.tracks.id)
        return added

    # -- what the smoother asks for ---------------------------------------------------------------

    def _gate_new(self) -> None:
        """Drop associations whose newest observation is far from the landmark of the map, too."""
        super()._gate_new()
        if not self.is_localized:
            return
        self.map_tracks.forget(self.tracks)
        terms = self._terms(None, self.rule.tilt_sigma_rad)
        newest = len(self._states) - 1
        far = contradicted_unless_most(
            terms.errors_px(self._states), terms.observations, self.options, frame=newest
        )
        self.map_tracks.refuse(self._used[far])
        self._checked_terms = None if far.any() else terms

    def _may_be_landmark(self) -> Mask:
        return ~self.map_tracks.includes(self.tracks.id)

    def _map_terms(self) -> MapTerms | None:
        if not self.is_localized:
            return None
        terms, self._checked_terms = self._checked_terms, None
        if terms is not None:
            return terms
        self.map_tracks.forget(self.tracks)
        return self._terms(None, self.rule.tilt_sigma_rad)

    def _leaving_map_terms(self) -> MapTerms | None:
        """Return the map terms of the first frame and of ended tracks that begin in it.

        Landmarks that are estimated leave with all their observations, and only when their track has
        ended; exact ones leave observation by observation.
        """
        if not self.is_localized:
            return None
        if not self.rule.estimates_landmarks:
            return self._terms(0, np.inf)
        return self._terms(None, np.inf, self._ended_map_tracks())

    def _forget_leaving_map_tracks(self) -> None:
        """Remove the observations of the map's landmarks that have entered the prior."""
        if not self.is_localized or not self.rule.estimates_landmarks:
            return
        rows = self._ended_map_tracks()
        ids = self.map_tracks.matches.track_id[rows]
        self.tracks.remove_tracks(np.searchsorted(self.tracks.id, ids), self._poses(), close=True)

    def _take_map_states(self) -> None:
        self.map_tracks.p_G[self._map_rows] = self._states.p_G

    def _covariance(self, problem: WindowProblem) -> F64:
        if not self.is_localized:
            return super()._covariance(problem)
        frames, others = FRAME_SIZE * len(self._states), len(self.calibration)
        newest = np.arange(frames - FRAME_SIZE, frames)
        joint = problem.covariance(
            self._states, np.concatenate([newest, frames + others + np.arange(6)])
        )
        self._pose = self._map_pose(joint)
        return joint[:FRAME_SIZE, :FRAME_SIZE]

    def _remove_outliers(self, problem: WindowProblem, order: I64) -> float:
        error_px = super()._remove_outliers(problem, order)
        if self.is_localized and self._latest_terms is not None:
            self._refuse_contradicted(self._latest_terms)
        return error_px

    # -- inside -----------------------------------------------------------------------------------

    def _terms(self, frame: int | None, tilt_sigma_rad: float, rows: I64 | None = None) -> MapTerms:
        observations, used = self.map_tracks.observations(
            self.tracks, self.rule.sigma_px, frame, rows
        )
        self._map_rows = used if self.rule.estimates_landmarks else used[:0]
        self._states = dataclasses.replace(self._states, p_G=self.map_tracks.p_G[self._map_rows])
        rig = self.calibration.cameras, self.calibration.T_I_C
        if len(self.calibration):
            rig = self.calibration.calibrated(self._states.calibration)
        self._latest_terms = MapTerms(
            observations, *rig,
            huber_sigmas=self.options.huber_sigmas, tilt_sigma_rad=tilt_sigma_rad,
        )  # fmt: skip
        self._used = used
        return self._latest_terms

    def _ended_map_tracks(self) -> I64:
        """Return the associations whose tracks have ended and are observed by the first frame."""
        tracks = self.tracks
        rows = np.searchsorted(tracks.id, self.map_tracks.matches.track_id)
        return np.flatnonzero(tracks.is_seen_by(0)[rows] & ~tracks.is_active[rows])

    def _map_pose(self, joint: F64) -> MapPose:
        """Return the pose, with the covariance (21, 21) of the newest frame and the base frame."""
        T_M_I, T_G_M = self._states.T_M_I[-1], self._states.T_G_M[0]
        covariance = np.full((6, 6), np.inf)
        if np.isfinite(joint).all():
            J, poses = composition_jacobian(T_G_M, T_M_I), np.r_[:6, FRAME_SIZE : FRAME_SIZE + 6]
            covariance = J @ joint[np.ix_(poses, poses)] @ J.T
        return MapPose(T_G_M, se3.compose(T_G_M, T_M_I), covariance)

    def _refuse_contradicted(self, terms: MapTerms) -> None:
        """Give tracks back to the odometry that do not observe their landmark after all."""
        seen = terms.observations
        if not len(seen):
            return
        error2 = terms.errors_px(self._states) ** 2
        mean2 = np.add.reduceat(error2, seen.start[:-1]) / np.diff(seen.start)
        is_wrong = ~(mean2 <= MAP_GATE_CHI2 * self.rule.sigma_px**2)
        if seen.information_G is not None:
            offset = self._states.p_G - seen.p_G
            chi2 = np.einsum("ai,aij,aj->a", offset, seen.information_G, offset)
            is_wrong |= chi2 > _LANDMARK_CHI2
        self.map_tracks.refuse(self._used[is_wrong])


def composition_jacobian(T_A_B: F64, T_B_C: F64) -> F64:
    """Return the Jacobian (6, 12) of T_A_C = T_A_B T_B_C by the tangents of T_B_C, then of T_A_B."""
    R_A_B, R_B_C = so3.to_matrix(T_A_B[:4]), so3.to_matrix(T_B_C[:4])
    J = np.zeros((6, 12))
    J[:3, :3], J[3:, 3:6] = R_A_B, np.eye(3)
    J[:3, 6:9], J[:3, 9:] = np.eye(3), -R_A_B @ so3.skew(T_B_C[4:])
    J[3:, 9:] = R_B_C.T
    return J
